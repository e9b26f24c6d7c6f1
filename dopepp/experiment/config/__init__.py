"""Typed configs; the docstring of each class describes its options.

To add an option, add it to a file in ``conf/`` and to the class of its node.
"""
