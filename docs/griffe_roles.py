"""Griffe extension that converts Sphinx roles in docstrings, ``:class:`X```, to code spans."""

import re
from typing import Any

import griffe


class Roles(griffe.Extension):
    """Removes roles: ``:class:`~dopepp.parts.Part``` becomes ```dopepp.parts.Part```."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of a loaded object."""
        if obj.docstring is not None:
            text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", obj.docstring.value)
            obj.docstring.value = text.replace("``", "`")
