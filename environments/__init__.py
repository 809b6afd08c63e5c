"""Constrained Markov decision processes: the vocabulary, RiverGrid, Safety Gym's tasks, exact solvers.

Depends on Gymnasium, not on torch. Import the modules by name; this file imports nothing.
"""
