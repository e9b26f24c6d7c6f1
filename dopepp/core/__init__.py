"""Basics of every package: errors, validation, files, JSON, YAML and process pools."""
