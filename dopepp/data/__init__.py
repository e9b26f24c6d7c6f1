"""Data: samples, readers, virtual images, mixing, masking, augmentation and the DataModule.

The torch-free modules (everything but ``batch``, ``loader`` and ``datamodule``) are imported from
where they are; nothing is imported here, so that rendering does not load torch.
"""
