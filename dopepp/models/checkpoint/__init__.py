"""The checkpoint: one self-describing file, written whole, read without trust."""
