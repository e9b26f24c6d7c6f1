"""Pose errors as pure functions, one accumulator over images, and the rows to compare with."""
