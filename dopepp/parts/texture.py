"""Materials and textures that a mesh names: found in its folder only, read whole or not at all."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath
from typing import Final

import numpy as np
from jaxtyping import UInt8

from dopepp.drawing.pictures import FORMATS, MAX_SIDE, read_picture
from dopepp.errors import UserError

MAX_MATERIAL_BYTES: Final = 10_000_000
"""Size of a material file: a hundred thousand materials, and a bound on memory."""


def companion_path(mesh_path: Path, name: str, field: str) -> Path:
    """Return the path of a file that a mesh file names.

    Args:
        mesh_path: The mesh's path.
        name: What it wrote, relative to its own folder; Windows separators are understood.
        field: Where the name stands, for the error.

    Raises:
        UserError: The name leads out of the mesh's folder, or there is no such file.
    """
    folder = mesh_path.parent.resolve()
    written = PureWindowsPath(name)  # splits at / and at \, and knows C:
    path = (folder / written.as_posix()).resolve()
    if written.anchor or not path.is_relative_to(folder):
        raise UserError(
            f"{mesh_path} whose {field} {name!r} lies outside of its folder",
            "files in the mesh's folder or below it",
            "copy the file beside the mesh and write its plain name",
        )
    if not path.is_file():
        raise UserError(
            f"{mesh_path} whose {field} {name!r} does not exist",
            "a file in the mesh's folder",
            "put the file there, or delete the line for a part without texture",
        )
    return path


def read_texture(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image as RGB, first row on top.

    Raises:
        UserError: It is no image, is damaged, or is larger than 8,192 pixels a side.
    """
    try:
        return read_picture(path)
    except ValueError as error:
        raise UserError(
            f"texture {path}: {error}",
            f"a whole {', '.join(FORMATS)} image of at most {MAX_SIDE}×{MAX_SIDE} pixels",
            "replace the image",
        ) from error


def read_text(path: Path) -> str:
    """Return a text file with plain line ends; a file name in any encoding in it stays intact."""
    return path.read_bytes().decode("utf-8", "surrogateescape").replace("\r\n", "\n")


def read_materials(path: Path) -> dict[str | None, str | None]:
    """Return the file name of each MTL material's colour map, None for one without.

    Raises:
        UserError: The file is too large, or a map has options, which would change how it lies on
            the part.
    """
    if path.stat().st_size > MAX_MATERIAL_BYTES:
        raise UserError(
            f"material file {path} of {path.stat().st_size / 1e6:.0f} MB",
            f"up to {MAX_MATERIAL_BYTES / 1e6:.0f} MB",
            "keep only the materials that the mesh uses",
        )
    maps: dict[str | None, str | None] = {}
    material: str | None = None
    for line in read_text(path).split("\n"):
        keyword, _, rest = line.strip().replace("\t", " ").partition(" ")
        if keyword.lower() == "newmtl":
            material = " ".join(rest.split())
            maps[material] = None
        elif keyword.lower() == "map_kd":
            if rest.strip().startswith("-"):
                raise UserError(
                    f"material file {path} with map_Kd {rest.strip()!r}",
                    "a file name without options",
                    "bake scale and offset into the texture coordinates",
                )
            maps[material] = rest.strip()
    return maps
