"""Loading of parts, by mesh file or by name of a built-in part.

The built-in parts are the paper's parts (§2.1): Servoholder, 77×77×7 mm, and PivConnector,
105×52×7 mm. The shapes are our own: a 4 mm plate with raised features on its front (+z) and
recesses in its back (−z), so that no rotation maps a part onto itself and every side reveals the
orientation.
Numbers in this module are millimetres; parts are in metres about the bounding box's centre.

To add a built-in part, write its solid with the shapes below and a function like ``servoholder``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, OpType

from dopepp.core.errors import UserError
from dopepp.parts.mesh import weld
from dopepp.parts.mesh.read import READERS, read_in_unit
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.parts.size import is_plausible, part_in_words

_log = logging.getLogger(__name__)

BACK: Final = -3.5
PLATE: Final = 0.5
FRONT: Final = 3.5
"""Heights along z of the back face, the plate's front face and the top of the features."""

RECESS: Final = 2.5  # Depth of a recess
SLOPE: Final = 1.5  # Inward lean of a feature's walls over its height
SEGMENTS: Final = 64  # Sides of a circle: deviates by at most 0.03 mm
TOLERANCE: Final = 1e-3
"""Shorter edges are rounding errors of cuts and would make degenerate triangles."""


@cache
def servoholder() -> Part:
    """Return the Servoholder: a plate with a servo's window, a frame, a bush and a chamfer."""
    plate = _rectangle((-38.5, -38.5), (38.5, 38.5), radius=5)
    plate -= _polygon((38.5, 16.5), (38.5, 38.5), (16.5, 38.5))
    plate -= _rectangle((4, -40), (17, -30))
    frame = _rectangle((-36, 0), (15, 31))
    bush, posts = _disc((-19, -20), 14), (_disc((24, 9), 6), _disc((20, -22), 6))
    ribs = (_slot((-10, -29), (14, 5), 5), _slot((32.5, -33), (32.5, 9), 5))
    window = _rectangle((-31, 5), (10, 26)) + _rectangle((-12, 20), (10, 40))
    holes = _rectangle((-31, 5), (10, 26)) + _disc((-19, -20), 7) + _slot((22, -11), (22, -3), 5)
    for screw in ((24, 9), (20, -22), (-33, -33), (-33, 34)):
        holes += _disc(screw, 2.2)
    pockets = (_rectangle((-36, -36), (-3, -3), radius=3), _polygon((13, 29), (27, 23), (34, 2)))
    solid = _prism(plate, BACK, PLATE)
    solid += _tapered(PLATE, FRONT, frame, bush, *posts, *ribs) ^ _prism(plate, PLATE, FRONT)
    sunk = (*pockets, _slot((-33, 34), (10, 34), 5))
    solid -= _tapered(BACK, BACK + RECESS, *sunk) - _prism(_disc((-19, -20), 10))
    solid -= _prism(holes) + _prism(window, PLATE, FRONT)
    return make_part("servoholder", _mesh(solid))


@cache
def pivconnector() -> Part:
    """Return the PivConnector: an arm with a pivot's eye at one end and a fork at the other."""
    plate = _rectangle((-26.5, -26), (52.5, 26), radius=3) + _disc((-26.5, 0), 26)
    plate -= _rectangle((30, -3), (54, 11)) + _polygon((52.5, 10), (52.5, 26), (34, 26))
    plate -= _slot((-2, -27), (14, -27), 10)
    eye, pad = _disc((-26.5, 0), 19), _rectangle((29, -26), (52.5, -6), radius=3)
    ribs = (_slot((-12, 9), (24, 18), 5), _slot((-12, -9), (30, -16), 5))
    bridge = _rectangle((22, -18), (29, 21))
    holes = _disc((-26.5, 0), 11) + _slot((-1, 0), (14, 2), 7)
    holes += _disc((41, -16), 4) + _disc((38, 17), 2.2) + _disc((-26.5, 22), 1.8)
    pockets = (_polygon((2, 24), (32, 24), (26, 8), (-4, 8)), _rectangle((16, -23), (34, -12), 2))
    groove = _disc((-26.5, 0), 22) ^ _rectangle((-60, -30), (-22, 4))
    solid = _prism(plate, BACK, PLATE)
    solid += _tapered(PLATE, FRONT, eye, pad, bridge, *ribs) ^ _prism(plate, PLATE, FRONT)
    sunk = (*pockets, groove)
    solid -= _tapered(BACK, BACK + RECESS, *sunk) - _prism(_disc((-26.5, 0), 15))
    solid -= _prism(holes)
    return make_part("pivconnector", _mesh(solid))


BUILTIN: Final[dict[str, Callable[[], Part]]] = {
    "servoholder": servoholder,
    "pivconnector": pivconnector,
}
"""Built-in parts by name."""


def load_part(path_or_name: str | Path, unit: str | None = None) -> Part:
    """Return a built-in part, or the part in a mesh file, named after the file.

    The part's size is logged, as a warning if the diameter is outside 1 cm – 2 m. The file's unit
    is by default as stated by its format, otherwise millimetres.

    Raises:
        UserError: The part or file does not exist, or the file is invalid (see
            :func:`~dopepp.parts.mesh.read.read_mesh`).
    """
    text = str(path_or_name)
    if text in BUILTIN:
        return BUILTIN[text]()
    path = Path(path_or_name)
    if path.suffix.lower() not in READERS:
        allowed = f"{', '.join(BUILTIN)}, or a path to {'/'.join(READERS)}"
        fix = "write one of these names, or pass a mesh file"
        raise UserError(f"unknown part {text!r}", allowed, fix)
    mesh, file_unit = read_in_unit(path, unit)
    part = replace(make_part(path.stem, mesh, unit=file_unit), unit=file_unit)
    _log.log(logging.INFO if is_plausible(part) else logging.WARNING, "%s", part_in_words(part))
    return part


def with_meshes(
    parts: Sequence[Part], given: Sequence[str] = (), unit: str | None = None
) -> list[Part]:
    """Return a checkpoint's parts, each with a mesh, in order.

    ``given`` meshes, as ``NAME=FILE``, replace the checkpoint's meshes. NAME may be omitted if it
    is the file's stem or if there is a single part. A warning is logged if a mesh differs from the
    trained mesh.

    Raises:
        UserError: A part has no mesh, a name is unknown, or a file is invalid.
    """
    names = [part.name for part in parts]
    chosen: dict[str, str] = {}
    for text in given:
        name, named, path = text.rpartition("=")
        if not named:
            single = len(names) == len(given) == 1
            name = names[0] if single else text if text in BUILTIN else Path(text).stem
        if name not in names:
            problem = f"--part {text}, which is not in the checkpoint"
            fix = "name the part of the file: --part NAME=FILE"
            raise UserError(problem, ", ".join(names), fix)
        chosen[name] = path
    return [_with_mesh(part, chosen.get(part.name), unit) for part in parts]


def _with_mesh(part: Part, chosen: str | None, unit: str | None) -> Part:
    """Return a part with the mesh of the file ``chosen`` or, for None, with its present mesh."""
    if chosen is None:
        if part.mesh is not None:
            return part
        fix = f"add --part {part.name}=FILE and its --unit"
        problem = f"no mesh of {part.name} in the checkpoint"
        raise UserError(problem, "a mesh file for every part without a mesh", fix)
    loaded = load_part(chosen, unit)
    if part.mesh_hash and not part.has_shape_of(loaded):
        _log.warning("the checkpoint was not trained on this mesh of %s (%s)", part.name, chosen)
    return replace(part, mesh=loaded.mesh, mesh_deviation=loaded.mesh_deviation)


def _tapered(foot: float, top: float, *sections: CrossSection) -> Manifold:
    """Extrude convex sections from ``foot`` to ``top`` (mm), shrunk by ``SLOPE`` on all sides."""
    # Walls that lean make the features visible from straight above.
    solids = []
    for section in sections:
        outlines = ((section, foot), (section.offset(-SLOPE, JoinType.Miter), top))
        rings = [np.insert(s.to_polygons()[0], 2, z, axis=1) for s, z in outlines]
        solids.append(Manifold.hull_points(np.vstack(rings)))
    return Manifold.batch_boolean(solids, OpType.Add)


def _polygon(*corners: tuple[float, float]) -> CrossSection:
    """Return a convex polygon (mm): the hull of its corners, in any order."""
    return CrossSection.hull_points(np.array(corners, np.float64))


def _rectangle(
    lower: tuple[float, float], upper: tuple[float, float], radius: float = 0.0
) -> CrossSection:
    """Return an axis-aligned rectangle (mm) whose corners are rounded by ``radius``."""
    (left, bottom), (right, top) = lower, upper
    xs, ys = (left + radius, right - radius), (bottom + radius, top - radius)
    if radius == 0:
        return _polygon(*((x, y) for x in xs for y in ys))
    return CrossSection.batch_hull([_disc((x, y), radius) for x in xs for y in ys])


def _disc(centre: tuple[float, float], radius: float) -> CrossSection:
    """Return a disc (mm), approximated by a polygon."""
    return CrossSection.circle(radius, SEGMENTS).translate(centre)


def _slot(start: tuple[float, float], end: tuple[float, float], width: float) -> CrossSection:
    """Return a band (mm) with round ends around the line from ``start`` to ``end``."""
    return CrossSection.batch_hull([_disc(start, width / 2), _disc(end, width / 2)])


def _prism(section: CrossSection, bottom: float = BACK, top: float = FRONT) -> Manifold:
    """Extrude a section along z between two heights (mm)."""
    return section.extrude(top - bottom).translate((0.0, 0.0, bottom))


def _mesh(solid: Manifold) -> Mesh:
    triangles = solid.as_original().simplify(TOLERANCE).to_mesh64()
    # Rounding to a nanometre (1e-6 mm) removes the last digits of sin and cos, which differ between
    # platforms, so that a part has one hash everywhere. Vertices that coincide then are merged.
    rounded = np.round(np.asarray(triangles.vert_properties)[:, :3], 6)
    vertices, faces = weld(rounded, np.asarray(triangles.tri_verts))
    a, b, c = faces.T
    proper = (a != b) & (b != c) & (c != a)
    return Mesh(vertices / 1000, faces[proper].astype(np.int32))
