"""Finite constrained Markov decision processes: tables, their exact solution, and the two-state examples."""
