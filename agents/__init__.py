"""Constrained learners (the paper's agents). Know tensors, never teachers.

Import the modules by name; this file imports nothing.
"""
