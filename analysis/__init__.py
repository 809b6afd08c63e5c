"""From a sweep's files to frames, statistics, figures and tables. Never imports torch or ray.

Import the modules by name; this file imports nothing.
"""
