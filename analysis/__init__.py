"""From a sweep's files to data frames, statistics, figures and tables. Independent of torch and ray.

Import the modules by name; this file imports nothing.
"""
