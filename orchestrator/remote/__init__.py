"""Sweeps whose files are kept in an object store."""
