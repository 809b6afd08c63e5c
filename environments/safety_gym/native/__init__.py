"""The compiled environment step of the Safety Gym tasks."""
