"""Experiments: the only package that knows Hydra; below it only plain values travel."""
