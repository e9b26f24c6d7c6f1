"""Multiruns: comparison of jobs, runners for other processes and hyperparameter search."""
