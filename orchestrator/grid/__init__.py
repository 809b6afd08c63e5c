"""The grid file: its schema and its trials."""
