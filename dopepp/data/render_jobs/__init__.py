"""Render jobs: a data set of any size, by any number of processes, stopped and resumed at will."""
