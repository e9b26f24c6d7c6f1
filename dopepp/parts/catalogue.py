"""A part by the text a user writes: a built-in part's name or the path of a mesh file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from dopepp.errors import UserError
from dopepp.parts.builtin import pivconnector, servoholder
from dopepp.parts.mesh import READERS, read_in_unit
from dopepp.parts.part import Part, make_part

BUILTIN: Final[dict[str, Callable[[], Part]]] = {
    "servoholder": servoholder,
    "pivconnector": pivconnector,
}
"""Built-in parts by name."""


def load_part(path_or_name: str | Path, unit: str | None = None) -> Part:
    """Return a built-in part, or the part in a mesh file, named after the file.

    Args:
        path_or_name: ``servoholder``, ``pivconnector``, or the path of a mesh file.
        unit: The file's unit; None takes the one it has by its format, or millimetres, which the
            log says. A built-in part has its size without it, so that one unit can go with a list
            of files and built-in parts.

    Raises:
        UserError: There is no such part or file, or the file cannot be used (see
            :func:`~dopepp.parts.mesh.read_mesh`).
    """
    text = str(path_or_name)
    if text in BUILTIN:
        return BUILTIN[text]()
    path = Path(path_or_name)
    if path.suffix.lower() not in READERS:
        raise UserError(
            f"unknown part {text!r}",
            f"{', '.join(BUILTIN)}, or a path to {'/'.join(READERS)}",
            "check the spelling",
        )
    mesh, taken = read_in_unit(path, unit)
    return make_part(path.stem, mesh, unit=taken)
