"""Render data sets of any size with any number of processes; jobs can stop and resume."""
