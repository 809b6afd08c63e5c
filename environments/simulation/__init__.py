"""MuJoCo for many environments at once: batches, compiled code, cameras, and checks of actions."""
