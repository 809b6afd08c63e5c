"""Cost-limit curricula (the paper's teachers): pure functions of serialisable state.

Import the modules by name; this file imports nothing.
"""
