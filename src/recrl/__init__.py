"""Relaxed Exploration Constrained Reinforcement Learning: curricula, agents, tasks and sweeps."""
