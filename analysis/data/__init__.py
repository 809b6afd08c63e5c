"""Data of a sweep: reading from files, exports and MLflow, merging parts, and validity checks."""
