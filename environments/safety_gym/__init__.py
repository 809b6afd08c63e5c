"""Safety Gym's tasks: their definitions, their MuJoCo model, one environment and a batch."""
