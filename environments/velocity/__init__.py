"""Safety-Gymnasium's velocity tasks: robots that run, with a cost above a threshold speed."""
