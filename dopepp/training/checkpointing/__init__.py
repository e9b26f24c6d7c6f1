"""Checkpoints that are whole or absent, and the one a run goes on from."""
