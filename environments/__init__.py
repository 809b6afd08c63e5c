"""Constrained Markov decision processes: the vocabulary, RiverGrid, Safety Gym's tasks, exact solvers.

Knows Gymnasium, never torch. Import the modules by name; this file imports nothing.
"""
