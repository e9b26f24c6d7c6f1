"""Pose errors as pure functions, metrics that accumulate them over images, and reference rows."""
