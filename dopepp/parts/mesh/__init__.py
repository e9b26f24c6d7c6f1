"""Mesh files and what is measured on triangles."""
