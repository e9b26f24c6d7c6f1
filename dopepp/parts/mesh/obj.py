"""OBJ files with one texture, OFF files, and triangulation of polygons.

trimesh is not used here (``tests/parts/mesh/test_library.py``): it omits truncated faces, misreads
indices, silently loses textures, splits vertices, and reads a truncated OFF file as a smaller mesh.
This module reports the first damaged line. Only shape and the ``map_Kd`` texture are read. Files
named by a mesh must lie in the mesh's folder.
"""

from __future__ import annotations

import math
import re
from array import array
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import Final

import numpy as np
from jaxtyping import Bool, Int

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import FORMATS, MAX_SIDE, RGBImage, read_picture
from dopepp.parts.mesh import Faces, Vertices
from dopepp.parts.part import RawMesh

MAX_OFF_BYTES: Final = 50_000_000  # size of an OFF file; parsing needs 15 times as much
MAX_MATERIAL_BYTES: Final = 10_000_000  # a hundred thousand materials; bounds memory

NO_COORDINATE: Final = -1  # Texture coordinate index of a corner without coordinates


def read_obj(path: Path) -> RawMesh:
    """Read an OBJ file; vertices with several texture coordinates (on seams) are split.

    Raises:
        UserError: A line is damaged, a polygon is not convex, a material file or a texture is
            missing, damaged or outside the mesh's folder, or there is more than one texture.
    """
    obj = ObjFile()
    for number, line in enumerate(_text(path).replace("\\\n", " ").split("\n"), start=1):
        try:
            obj.add(line, number)
        except ValueError as error:
            problem = f"mesh {path} with the damaged line {number} {line.strip()[:60]!r} ({error})"
            allowed = "a complete OBJ file whose faces refer to preceding vertices"
            raise UserError(problem, allowed, "export the mesh again") from error
    positions = np.array(obj.positions, np.float64).reshape(-1, 3)
    corners = np.array(obj.corners, np.int64).reshape(-1, 2)
    try:
        corners = corners[fans(positions, corners[:, 0], np.array(obj.counts, np.int64))]
    except FoldedPolygonError as error:
        problem = f"mesh {path} with a polygon that is not convex in line {obj.lines[error.number]}"
        fix = "switch on 'triangulate' when exporting the mesh"
        raise UserError(problem, "triangles and convex polygons", fix) from error
    texture = _texture(obj, path)
    if texture is None:
        return RawMesh(positions, corners[..., 0])
    if (corners[..., 1] == NO_COORDINATE).any():
        problem = f"textured mesh {path} with faces without texture coordinates"
        fix = "unwrap the whole mesh, or delete its map_Kd line"
        raise UserError(problem, "texture coordinates (vt) on every face", fix)
    pairs, faces = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    uv = np.array(obj.coordinates, np.float64).reshape(-1, 2)[pairs[:, 1]]
    return RawMesh(positions[pairs[:, 0]], faces.reshape(-1, 3), uv, texture)


@dataclass
class ObjFile:
    """Statements of an OBJ file, 0-based indices, in arrays (a tenth of the memory of lists)."""

    positions: array[float] = field(default_factory=lambda: array("d"))  # x, y, z of each v
    coordinates: array[float] = field(default_factory=lambda: array("d"))  # u, v of each vt
    corners: array[int] = field(default_factory=lambda: array("q"))  # position, coordinate index
    counts: array[int] = field(default_factory=lambda: array("q"))  # corners of each f
    lines: array[int] = field(default_factory=lambda: array("q"))  # line number of each f
    materials: set[str | None] = field(default_factory=set)  # None: before any usemtl
    libraries: list[str] = field(default_factory=list)
    _material: str | None = None

    def add(self, line: str, number: int) -> None:
        """Parse a line and append its statement; unsupported statements are ignored.

        Raises:
            ValueError: The line is damaged.
        """
        match line.split():
            case ["v", *words]:
                self.positions.extend(_numbers(words, 3))
            case ["vt", *words]:
                self.coordinates.extend(_numbers(words, 2))
            case ["f", *words]:
                if len(words) < 3:
                    raise ValueError("a face needs at least 3 corners")
                for word in words:
                    position, coordinate, *_ = [*word.split("/"), ""]
                    self.corners.append(_index(position, len(self.positions) // 3))
                    count = len(self.coordinates) // 2
                    self.corners.append(_index(coordinate, count) if coordinate else NO_COORDINATE)
                self.counts.append(len(words))
                self.lines.append(number)
                self.materials.add(self._material)
            case ["usemtl", *words]:
                self._material = " ".join(words)
            case ["mtllib", *_]:
                self.libraries.append(line.strip().removeprefix("mtllib").strip())


def _numbers(words: list[str], count: int) -> list[float]:
    """Convert the first ``count`` words of a line to finite numbers."""
    numbers = [float(word) for word in words[:count]]
    if len(numbers) < count:
        raise ValueError(f"fewer than {count} numbers")
    if not all(map(math.isfinite, numbers)):
        raise ValueError("a coordinate that is not a finite number")
    return numbers


def _index(word: str, count: int) -> int:
    """Convert a 1-based index, or a negative index from the end, to a 0-based index."""
    index = int(word)
    if not 1 <= abs(index) <= count:
        raise ValueError(f"index {index} among {count}")
    return index - 1 if index > 0 else count + index


def _texture(obj: ObjFile, path: Path) -> RGBImage | None:
    """Read the texture of the materials that the faces use; None without a texture."""
    if not obj.libraries:
        return None
    maps: dict[str | None, str | None] = {None: None}
    for library in obj.libraries:
        maps |= _colour_maps(companion_path(path, library, "mtllib"))
    unknown = sorted(name for name in obj.materials if name not in maps and name is not None)
    if unknown:
        problem = f"mesh {path} that uses the material {unknown[0]!r}"
        allowed = f"materials of {', '.join(obj.libraries)}"
        fix = "export the mesh again together with its materials"
        raise UserError(problem, allowed, fix)
    used = {maps[name] for name in obj.materials}
    if len(used) > 1:
        problem = f"mesh {path} with faces of {len(used)} textures ({', '.join(map(str, used))})"
        fix = "bake them into one texture, or delete the map_Kd lines"
        raise UserError(problem, "one texture for all faces, or none", fix)
    name = next(iter(used), None)
    return None if name is None else read_texture(companion_path(path, name, "map_Kd"))


def _colour_maps(path: Path) -> dict[str | None, str | None]:
    """Return the file name of the colour map, or None, for each material of an MTL file."""
    if (size := path.stat().st_size) > MAX_MATERIAL_BYTES:
        allowed = f"up to {MAX_MATERIAL_BYTES / 1e6:.0f} MB"
        fix = "delete the materials that the mesh does not use"
        raise UserError(f"material file {path} of {size / 1e6:.0f} MB", allowed, fix)
    maps: dict[str | None, str | None] = {}
    material: str | None = None
    for line in _text(path).split("\n"):
        keyword, _, rest = line.strip().replace("\t", " ").partition(" ")
        if keyword.lower() == "newmtl":
            material = " ".join(rest.split())
            maps[material] = None
        elif keyword.lower() == "map_kd":
            if rest.strip().startswith("-"):  # options transform the texture
                problem = f"material file {path} with map_Kd {rest.strip()!r}"
                fix = "bake scale and offset into the texture coordinates"
                raise UserError(problem, "a file name without options", fix)
            maps[material] = rest.strip()
    return maps


def _text(path: Path) -> str:
    return path.read_bytes().decode("utf-8", "surrogateescape").replace("\r\n", "\n")


def companion_path(mesh_path: Path, name: str, statement: str) -> Path:
    """Return the path of the file ``name`` that a mesh file refers to in a ``statement``.

    Raises:
        UserError: The file is missing or outside the mesh's folder.
    """
    folder = mesh_path.parent.resolve()
    written = PureWindowsPath(name)  # splits at / and at \, and recognises C:
    path = (folder / written.as_posix()).resolve()
    problem = f"{mesh_path} whose {statement} {name!r}"
    if written.anchor or not path.is_relative_to(folder):
        fix = "copy the file into the mesh's folder and write its plain name"
        allowed = "a file in the mesh's folder or below"
        raise UserError(f"{problem} lies outside of its folder", allowed, fix)
    if not path.is_file():
        fix = f"copy the file to {path}, or delete the {statement} line if the part has no texture"
        raise UserError(f"{problem} does not exist", "a file in the mesh's folder", fix)
    return path


def read_texture(path: Path) -> RGBImage:
    """Read a texture image as RGB.

    Raises:
        UserError: The image is damaged or larger than 8,192 pixels a side.
    """
    try:
        return read_picture(path, upright=False)
    except ValueError as error:
        allowed = f"a complete {', '.join(FORMATS)} image of at most {MAX_SIDE}×{MAX_SIDE} pixels"
        fix = "save the texture again in this form"
        raise UserError(f"texture {path}: {error}", allowed, fix) from error


def read_off(path: Path) -> RawMesh:
    """Read the shape of an OFF file of triangles and convex polygons.

    Raises:
        ValueError: The file is damaged or too large, or a polygon is not convex.
    """
    if path.stat().st_size > MAX_OFF_BYTES:
        raise ValueError(f"over {MAX_OFF_BYTES / 1e6:.0f} MB of text")
    header, mark, text = re.sub("#.*", "", path.read_text("utf-8")).partition("OFF")
    if not mark or header.strip() not in ("", "C"):
        raise ValueError("no OFF header")
    promised, *rows = [line.split() for line in text.splitlines() if line.strip()]
    num_vertices, num_faces = map(int, promised[:2])
    if min(num_vertices, num_faces) < 0 or len(rows) != num_vertices + num_faces:
        stated = f"{num_vertices} vertices and {num_faces} faces"
        raise ValueError(f"{len(rows)} lines, but the header states {stated}")
    vertices = np.array([row[:3] for row in rows[:num_vertices]], np.float64).reshape(-1, 3)
    polygons = [[int(word) for word in row[: int(row[0]) + 1]] for row in rows[num_vertices:]]
    for number, (count, *corners) in enumerate(polygons):
        if len(corners) != count:
            raise ValueError(f"face {number} with {len(corners)} instead of {count} corners")
    counts = np.array([count for count, *_ in polygons], np.int64)
    row_of_corners = np.array([i for _, *corners in polygons for i in corners], np.int64)
    return RawMesh(vertices, row_of_corners[fans(vertices, row_of_corners, counts)])


def fans(
    vertices: Vertices, corners: Int[np.ndarray, " corners"], counts: Int[np.ndarray, " polygons"]
) -> Int[np.ndarray, "triangles 3"]:
    """Triangulate polygons as fans around their first corners.

    ``corners`` are the vertex indices polygon by polygon, which are not checked here; ``counts``
    are the numbers of corners of the polygons.

    Returns:
        Triangles as indices into ``corners``.

    Raises:
        FoldedPolygonError: A polygon is not convex.
        ValueError: A polygon has fewer than three corners.
    """
    if (counts < 3).any():
        raise ValueError(f"face {int((counts < 3).argmax())} with fewer than 3 corners")
    polygons = np.repeat(np.arange(len(counts)), counts - 2)
    first = (np.cumsum(counts) - counts)[polygons]
    # Number of each triangle within its polygon.
    number = np.arange(len(polygons)) - (np.cumsum(counts - 2) - (counts - 2))[polygons]
    triangles = np.stack([first, first + number + 1, first + number + 2], axis=1)
    faces = corners[triangles]
    if (counts > 3).any() and 0 <= faces.min() <= faces.max() < len(vertices):
        folded = _find_folded(vertices, faces, polygons)
        if folded.any():
            raise FoldedPolygonError(int(polygons[folded.argmax()]))
    return triangles


class FoldedPolygonError(ValueError):
    """A polygon, numbered from 0, is not convex, so a fan does not cover it."""

    def __init__(self, number: int) -> None:
        super().__init__(f"a polygon that is not convex, face {number}")
        self.number = number


def _find_folded(
    vertices: Vertices, faces: Faces, polygons: Int[np.ndarray, " faces"]
) -> Bool[np.ndarray, " faces"]:
    """Mark triangles that face against their polygon's mean normal, or whose polygon has none."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    totals = np.zeros((int(polygons[-1]) + 1, 3))
    np.add.at(totals, polygons, normals)
    squared = np.einsum("pi,pi->p", totals, totals)
    # The normal of a degenerate triangle is arbitrary.
    folded = np.einsum("fi,fi->f", normals, totals[polygons]) < -1e-9 * squared[polygons]
    # The halves of a bow tie cancel out.
    parts = np.bincount(polygons, np.einsum("fi,fi->f", normals, normals))
    tiny = 1e-12 * np.square(np.ptp(vertices, axis=0)).sum()
    cancelled = (squared <= 1e-9 * parts) & (parts > tiny * tiny)
    return np.asarray(folded | cancelled[polygons])
