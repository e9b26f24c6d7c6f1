"""The renderers to choose from, by name; each is imported when it is asked for.

To add one, write a module with ``render(scene) -> Rendered`` and one line in :data:`RENDERERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Final

from dopepp.core.errors import UserError
from dopepp.virtual.scene import Rendered, Scene

Renderer = Callable[[Scene], Rendered]
"""Draws a scene as an ideal camera sees it; the factory applies the scene's sensor."""

RENDERERS: Final = {
    "raster": "dopepp.virtual.renderers.raster",
    "photoreal": "dopepp.virtual.renderers.photoreal.renderer",
}
"""Module of each renderer."""


def find_renderer(name: str) -> Renderer:
    """Return a renderer by name; a UserError where it is unknown or its extra not installed."""
    if name not in RENDERERS:
        raise UserError(f"renderer {name!r}", ", ".join(RENDERERS), "choose one of them")
    render: Renderer = import_module(RENDERERS[name]).render
    return render
