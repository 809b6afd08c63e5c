"""The grid file: its schema, the trials it describes, and the plan that it makes of what is on disk."""
