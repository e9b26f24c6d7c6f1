"""Data: samples, readers, virtual images, mixing, masking, augmentation and the DataModule.

Only ``batch`` and ``datamodule`` import torch. This file imports nothing, so that rendering does
not load torch.
"""
