"""Basics for all packages: errors, validation, files, JSON, YAML and process pools."""
