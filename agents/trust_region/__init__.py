"""Conjugate gradient, line search, and the exact dual of CPO's step."""
