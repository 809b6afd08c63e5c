"""Safety-Gymnasium's velocity tasks: MuJoCo robots that earn by running and pay for running too fast."""
