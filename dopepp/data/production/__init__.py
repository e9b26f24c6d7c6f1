"""Render jobs: a data set of any size, by any number of processes, stopped and resumed at will.

``job`` says what is rendered, ``folder`` where, ``shards`` which part of it; ``work`` does one
piece, and the pools (``processes``, ``cluster``) spread the pieces. ``produce`` puts them together.
"""
