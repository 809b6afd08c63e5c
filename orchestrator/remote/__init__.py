"""Sweeps in an object store."""
