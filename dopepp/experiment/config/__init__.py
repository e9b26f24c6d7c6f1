"""The composed configuration as typed values."""
