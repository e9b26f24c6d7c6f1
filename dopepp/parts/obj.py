"""A strict Wavefront OBJ reader: positions, faces, texture coordinates, one texture.

A reader of its own, because a damaged line must be an error that names it, and a missing texture
too. Normals, groups, smoothing, lines, colours and all maps but ``map_Kd`` are left out: a part's
look is its shape and its texture.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from dopepp.errors import UserError
from dopepp.parts.measure import RawMesh, first_folded_polygon
from dopepp.parts.texture import companion_path, read_materials, read_text, read_texture

NO_COORDINATE = -1
"""Index of the texture coordinate of a corner that has none."""


@dataclass
class ObjFile:
    """An OBJ file's statements, triangulated, indices from 0.

    Attributes:
        positions: x, y, z of each ``v`` line, one after the other.
        coordinates: u, v of each ``vt`` line, one after the other.
        triangles: Per triangle the position and coordinate indices of its three corners.
        polygons: Per triangle the number of the ``f`` line it was cut from.
        materials: Names of the materials that faces use; None for faces before any ``usemtl``.
        libraries: Names of the MTL files.
    """

    # Arrays take a tenth of the memory of lists of lists.
    positions: array[float] = field(default_factory=lambda: array("d"))
    coordinates: array[float] = field(default_factory=lambda: array("d"))
    triangles: array[int] = field(default_factory=lambda: array("q"))
    polygons: array[int] = field(default_factory=lambda: array("q"))
    materials: set[str | None] = field(default_factory=set)
    libraries: list[str] = field(default_factory=list)
    _material: str | None = None

    def add(self, line: str, number: int) -> None:
        """Take in one line.

        Raises:
            ValueError: The line is damaged.
        """
        keyword, *words = line.split()
        if keyword == "v":
            self.positions.extend(_numbers(words, 3))
        elif keyword == "vt":
            self.coordinates.extend(_numbers(words, 2))
        elif keyword == "f":
            self._add_face(words, number)
        elif keyword == "usemtl":
            self._material = " ".join(words)
        elif keyword == "mtllib":
            self.libraries.append(line.strip()[len(keyword) :].strip())

    def _add_face(self, words: list[str], number: int) -> None:
        """Cut a polygon into a fan of triangles around its first corner."""
        corners = [self._corner(word) for word in words]
        if len(corners) < 3:
            raise ValueError("a face needs at least 3 corners")
        for second, third in pairwise(corners[1:]):
            self.triangles.extend((*corners[0], *second, *third))
        self.polygons.extend([number] * (len(corners) - 2))
        self.materials.add(self._material)

    def _corner(self, word: str) -> tuple[int, int]:
        position, _, rest = word.partition("/")
        coordinate = rest.partition("/")[0]
        index = NO_COORDINATE
        if coordinate:
            index = _index(coordinate, len(self.coordinates) // 2)
        return _index(position, len(self.positions) // 3), index


def read_obj(path: Path) -> RawMesh:
    """Read an OBJ file: vertices in the file's unit, faces, and uv and texture where it has one.

    A textured vertex that has several texture coordinates (on a seam) becomes several vertices.

    Raises:
        UserError: A line is damaged, a polygon is not convex, a material file or a texture is
            missing, outside of the folder or damaged, or there is more than one texture.
    """
    obj = _parse(path)
    corners = np.array(obj.triangles, np.int64).reshape(-1, 3, 2)
    positions = np.array(obj.positions, np.float64).reshape(-1, 3)
    folded = first_folded_polygon(positions, corners[..., 0], np.array(obj.polygons, np.int64))
    if folded is not None:
        raise UserError(
            f"mesh {path} with a polygon that is not convex in line {folded}",
            "triangles and convex polygons",
            "switch on 'triangulate' when exporting the mesh",
        )
    texture = _texture(obj, path)
    if texture is None:
        return positions, corners[..., 0], None, None
    if (corners[..., 1] == NO_COORDINATE).any():
        raise UserError(
            f"textured mesh {path} with faces without texture coordinates",
            "texture coordinates (vt) on every face",
            "unwrap the whole mesh, or delete its map_Kd line",
        )
    pairs, faces = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    uv = np.array(obj.coordinates, np.float64).reshape(-1, 2)[pairs[:, 1]]
    return positions[pairs[:, 0]], faces.reshape(-1, 3), uv, texture


def _parse(path: Path) -> ObjFile:
    obj = ObjFile()
    for number, line in enumerate(read_text(path).replace("\\\n", " ").split("\n"), start=1):
        if not line.strip():
            continue
        try:
            obj.add(line, number)
        except ValueError as error:
            raise UserError(
                f"mesh {path} with the damaged line {number} {line.strip()[:60]!r} ({error})",
                "a whole OBJ file whose faces name vertices above them",
                "export the mesh again",
            ) from error
    return obj


def _numbers(words: list[str], count: int) -> list[float]:
    if len(words) < count:
        raise ValueError(f"needs {count} numbers")
    numbers = [float(word) for word in words[:count]]
    if not all(map(math.isfinite, numbers)):
        raise ValueError("a coordinate that is not a finite number")
    return numbers


def _index(word: str, count: int) -> int:
    """Turn an index from 1, or from the end if negative, into one from 0."""
    index = int(word)
    if not 1 <= abs(index) <= count:
        raise ValueError(f"index {index} among {count}")
    return index - 1 if index > 0 else count + index


def _texture(obj: ObjFile, path: Path) -> UInt8[np.ndarray, "height width 3"] | None:
    """Read the one texture that the used materials name, or return None if they name none."""
    if not obj.libraries:
        return None
    maps: dict[str | None, str | None] = {None: None}
    for library in obj.libraries:
        maps |= read_materials(companion_path(path, library, "mtllib"))
    unknown = sorted(name for name in obj.materials if name not in maps and name is not None)
    if unknown:
        raise UserError(
            f"mesh {path} that uses the material {unknown[0]!r}",
            f"materials of {', '.join(obj.libraries)}",
            "export the mesh again together with its materials",
        )
    used = {maps[name] for name in obj.materials}
    if len(used) > 1:
        raise UserError(
            f"mesh {path} with faces of {len(used)} textures ({', '.join(map(str, used))})",
            "one texture for all faces, or none",
            "bake them into one texture, or delete the map_Kd lines",
        )
    name = next(iter(used), None)
    return None if name is None else read_texture(companion_path(path, name, "map_Kd"))
