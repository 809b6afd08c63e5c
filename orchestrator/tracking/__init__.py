"""The sweep in MLflow."""
