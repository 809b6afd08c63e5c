"""Measurement of constraints and update rules of Lagrange multipliers."""
