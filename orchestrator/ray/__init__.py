"""Trials on Ray: the executor, the cluster's nodes and services, and the teacher actor."""
