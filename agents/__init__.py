"""Constrained learners (the paper's students). Know tensors, never teachers.

Import the modules by name; this file imports nothing.
"""
