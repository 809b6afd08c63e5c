"""The grid file: its schema, its trials, and the plan for a launch."""
