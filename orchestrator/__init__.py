"""Sweeps of trials: grid files, the trial, its files, Ray Tune, MLflow, the command line.

Import the modules by name; this file imports nothing.
"""
