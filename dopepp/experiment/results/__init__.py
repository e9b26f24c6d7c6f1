"""Measurement of methods, reports, tables and comparisons."""
