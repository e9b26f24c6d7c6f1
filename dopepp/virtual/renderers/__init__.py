"""Renderers by name, imported on demand.

To add a renderer, write a module with ``render(scene) -> Rendered`` and add it to
:data:`RENDERERS`, or add an entry point ``dopepp.renderers`` (:mod:`dopepp.core.extensions`). If
more than the code of ``dopepp`` determines the images, e.g. the version of another library, add
``identity() -> str``.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Final

from dopepp.core import extensions
from dopepp.core.errors import UserError
from dopepp.virtual.scene import Rendered, Scene

Renderer = Callable[[Scene], Rendered]
"""Renders a scene for an ideal camera; the factory applies the scene's sensor."""

RENDERERS: Final = {
    "raster": "dopepp.virtual.renderers.raster",
    "photoreal": "dopepp.virtual.renderers.photoreal.renderer",
}
"""Module of each renderer."""


def find_renderer(name: str) -> Renderer:
    """Import and return a renderer by its name in :data:`RENDERERS` or in an extension.

    Raises:
        UserError: The renderer is unknown, or a package that it needs is not installed.
    """
    render: Renderer = _module(name).render
    return render


def renderer_identity(name: str) -> str:
    """Return the identity that a renderer publishes, or an empty string.

    Images that were rendered with another identity or another ``code_hash`` are not reused.

    Raises:
        UserError: As for :func:`find_renderer`, or the renderer cannot run in this process.
    """
    identity: Callable[[], str] = getattr(_module(name), "identity", str)
    return identity()


def survives_fork(name: str) -> bool:
    """Return whether a process that has rendered may fork, and the fork render on.

    Mitsuba's threads end with a fork, and other renderers are not known.
    """
    return name == "raster"


def _module(name: str) -> ModuleType:
    modules = (
        RENDERERS if name in RENDERERS else {**extensions.components("renderers"), **RENDERERS}
    )
    if name not in modules:
        fix = f"choose one of these names, or {extensions.advice('renderers', name)}"
        raise UserError(f"renderer {name!r}", ", ".join(modules), fix)
    return import_module(modules[name])
