"""Experiments: the only package that imports Hydra; other packages receive plain values."""
