"""Safety Gym's tasks: what they are, their MuJoCo model, one environment and a batch of them."""
