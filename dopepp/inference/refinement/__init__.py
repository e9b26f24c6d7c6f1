"""Refinement of recovered poses on the image and on a depth image."""
