"""Inference: an image and a camera matrix in, poses out; no training, no data sets."""
