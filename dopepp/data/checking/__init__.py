"""Validate a data set on disk, whatever its layout: every defect with its file and field."""
