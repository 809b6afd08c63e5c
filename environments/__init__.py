"""Constrained Markov decision processes: RiverGrid, Safety Gym, velocity tasks, users' tasks, exact solvers.

Depends on Gymnasium, not on torch. Import the modules by name; this file imports nothing.
"""
