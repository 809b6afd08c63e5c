"""Constrained learners (the paper's agents). They depend on torch, not on curricula.

Import the modules by name; this file imports nothing.
"""
