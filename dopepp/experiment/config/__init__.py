"""The composed configuration as typed values: the classes' docstrings say what each option means.

To add an option, give it a line in ``conf/`` and a field in the class of its node.
"""
