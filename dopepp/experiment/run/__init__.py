"""The folder of a run: what it records, how it goes on, what is told of it."""
