"""Transforms of samples for training and for shading tests."""
