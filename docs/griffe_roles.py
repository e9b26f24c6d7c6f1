"""Docstrings name things as Sphinx does, ``:class:`X```; the site shows that as code."""

import re
from typing import Any

import griffe


class Roles(griffe.Extension):
    """Takes the role off: ``:class:`~dopepp.parts.Part``` becomes ```Part```."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of whatever was loaded."""
        if obj.docstring is not None:
            text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", obj.docstring.value)
            obj.docstring.value = text.replace("``", "`")
