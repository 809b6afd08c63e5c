"""A sweep's data: reading it from files, exports and MLflow, merging parts, and checking validity."""
