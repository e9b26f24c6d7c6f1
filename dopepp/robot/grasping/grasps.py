"""Grasps of a part: their YAML file, and proposals for any mesh.

.. code-block:: yaml

    part: bracket
    grasps:
    - {point: [0.0, 0.0, 0.002], closing: [1, 0, 0], approach: [0, 0, -1], width: 0.03}

The best grasps come first. ``point`` is the midpoint between the fingers, ``closing`` the direction
of their closing, ``approach`` the direction of the gripper's motion, and ``width`` the part's width
between the fingers, all in the part's frame and metres.

:func:`propose_grasps` samples points of the surface and pairs them with the points behind them
along the normal. Pairs with opposite normals within the pads' friction are antipodal (Nguyen 1988).
Pairs are tested on the faces on which the part can lie: the approach is from above, and the volumes
of fingers and palm must be free. The score prefers large contact areas under both pads and points
close to the centre of mass.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import trimesh
import yaml
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, write_file
from dopepp.core.validation import STRICT, Range, parse
from dopepp.core.yaml import read_yaml
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.rotation import Vector
from dopepp.parts.part import MAX_NAME, Mesh, Part
from dopepp.virtual.body import make_body

MAX_GRASPS: Final = 1000
MAX_OPENING: Final = 0.085  # largest opening of the fingers (2F-85), metres
CLEARANCE: Final = 0.006  # preferred distance of each descending finger from the part, metres
PAD_HALF: Final = np.array([0.004, 0.011, 0.009375])
"""Half the thickness, width and length of a finger pad, metres. A finger has two pads in a row."""

# Distances of the pads' ends beyond a grasp's point, metres: half a pad, or less above an obstacle.
INSERTIONS: Final = (0.009, 0.003, 0.0015)
ABOVE_BENCH: Final = 0.001  # smallest distance of the pads' ends from the bench, metres
PAIRS: Final = 1500  # sampled points for the search of pairs
FACES: Final = 8  # number of the most common resting faces
MAX_PAIRS: Final = 100  # largest number of pairs that are tested on a face
SAMPLES: Final = 5000  # points that represent the surface in tests of collisions and contacts
MIN_WIDTH: Final = 0.002  # smallest width of a grasp, metres
FRICTION_ANGLE: Final = math.radians(15.0)  # of normals to the closing; friction 0.6 holds 31°
STEEPEST_CLOSING: Final = math.sin(math.radians(37.0))  # vertical component of a closing direction
TILTS: Final = np.radians([0.0, 25.0, -25.0])  # of an approach about the closing direction
FULL_CONTACT: Final = 80e-6  # contact area of a pad for the full score (a fifth of the pad), m²
MIN_CONTACT: Final = 12e-6  # smallest contact area of each pad, m²
FINGER: Final = 0.025  # thickness of a finger behind its pad, metres
# Opposite corners of the gripper body's box, tool axes, relative to the pads' ends, metres.
PALM: Final = np.array([[-0.075, -0.04, -0.16], [0.075, 0.04, -0.055]])
FLAT: Final = math.cos(FRICTION_ANGLE)
# Smallest distance (metres) or angle (radians) between distinct grasps of a face.
DISTINCT: Final = (0.008, math.radians(20.0))
BUILT_IN: Final = Path(__file__).parent / "data"
Points = Float[np.ndarray, "n 3"]
FIX: Final = "correct the file, or create a new file with `dopepp grasp propose`"


@dataclass(frozen=True, eq=False)
class Grasp:
    """A two-finger grasp in a part's frame."""

    point: Vector  # midpoint between the fingers, metres
    closing: Vector  # direction of the fingers' closing, unit vector
    approach: Vector  # direction of the gripper's motion to the part, unit vector
    width: float  # width of the part between the fingers, metres

    @property
    def opening(self) -> float:
        """Distance between the fingers during the approach: width plus clearance, metres."""
        return min(self.width + 2 * CLEARANCE, MAX_OPENING)

    def T_obj_tool(self, flipped: bool) -> Transform:  # noqa: N802
        """Return the tool's pose: origin point, z approach, x closing (−closing if flipped)."""
        x, z = -self.closing if flipped else self.closing, self.approach
        return make_transform(np.stack([x, np.cross(z, x), z], axis=1), self.point)


def find_grasps(part: Part, path: Path | None = None) -> tuple[Grasp, ...]:
    """Return a part's grasps, best first, from a file (default: the file of a built-in part).

    Raises:
        UserError: The file is invalid or of another part, or the part has no built-in file.
    """
    built_in = BUILT_IN / f"{part.name}.yaml"
    if path is None and not built_in.is_file():
        raise UserError(
            f"part {part.name} without a grasp",
            "a file of grasps for every part that is not built in",
            f"dopepp grasp propose {part.name}.stl --out {part.name}.yaml, then "
            f"--grasps {part.name}.yaml",
        )
    return read_grasps(path or built_in, part)


@dataclass(frozen=True)
class _GraspRecord:
    __pydantic_config__ = STRICT

    point: tuple[float, float, float]
    closing: tuple[float, float, float]
    approach: tuple[float, float, float]
    width: Annotated[float, Range(1e-4, MAX_OPENING, "metres")]


@dataclass(frozen=True)
class _GraspFile:
    __pydantic_config__ = STRICT

    part: str
    grasps: list[_GraspRecord]


def read_grasps(path: Path, part: Part) -> tuple[Grasp, ...]:
    """Read a YAML file of grasps.

    Raises:
        UserError: The file is invalid, or of another part.
    """
    content = parse(_GraspFile, read_yaml(path), str(path), FIX)
    if content.part != part.name:
        raise UserError(f"{path}, part: {content.part!r:.100}", f"part: {part.name}", FIX)
    if not 0 < len(content.grasps) <= MAX_GRASPS:
        problem = f"{path}, part {part.name} with {len(content.grasps)} grasps"
        raise UserError(problem, f"1 to {MAX_GRASPS} grasps", FIX)
    return tuple(
        _check_grasp(record, f"{path}.grasps[{number}]", part)
        for number, record in enumerate(content.grasps)
    )


def _check_grasp(record: _GraspRecord, name: str, part: Part) -> Grasp:
    """Return a record's grasp; reject a point off the part, and directions not at a right angle."""
    point, closing, approach = map(np.array, (record.point, record.closing, record.approach))
    lower, upper = part.cuboid.min(axis=0) - 0.01, part.cuboid.max(axis=0) + 0.01
    if not ((point >= lower) & (point <= upper)).all():
        raise UserError(f"{name}.point={list(record.point)}", "a point of the part, metres", FIX)
    lengths = [float(np.linalg.norm(direction)) for direction in (closing, approach)]
    if min(lengths) < 1e-6 or abs(closing @ approach) > 0.02 * lengths[0] * lengths[1]:
        problem = f"{name} with closing={record.closing} and approach={record.approach}"
        raise UserError(problem, "two directions at a right angle", FIX)
    z = approach / lengths[1]
    x = closing - (closing @ z) * z
    return Grasp(point, x / np.linalg.norm(x), z, record.width)


def write_grasps(path: Path, part: Part, grasps: Sequence[Grasp]) -> None:
    """Write grasps to a YAML file, one per line."""
    check_target(path, (".yaml", ".yml"))

    def text(numbers: Iterable[float]) -> str:
        # YAML reads an exponent as text, and −0 becomes 0.
        return ", ".join(f"{round(x, 5) + 0.0:.5f}".rstrip("0").rstrip(".") for x in numbers)

    # A name of digits is quoted.
    head = yaml.safe_dump({"part": part.name}, allow_unicode=True, width=2 * MAX_NAME)
    lines = [head.rstrip(), "grasps:"]
    for grasp in grasps:
        names = ("point", "closing", "approach")
        vectors = ", ".join(f"{name}: [{text(getattr(grasp, name))}]" for name in names)
        lines.append(f"- {{{vectors}, width: {text([grasp.width])}}}")
    write_file(path, ("\n".join(lines) + "\n").encode())


def propose_grasps(part: Part, count: int, seed: int = 0) -> tuple[Grasp, ...]:
    """Propose at most ``count`` grasps from above for the stable faces on which a part can rest.

    Returns:
        Grasps by resting face, the most common face first; of each face, the best grasp first.

    Raises:
        UserError: The part has no mesh, or no grasp was found.
    """
    body = make_body(part, is_target=True)
    assert part.mesh is not None
    rng = np.random.default_rng(seed)
    normals, shares = body.hull.rests
    pairs = list(_pairs(part.mesh, rng))
    surface = _sample_surface(part.mesh, SAMPLES, rng)
    faces = np.argsort(-shares, kind="stable")[:FACES]
    each = math.ceil(count / len(faces))
    grasps: list[Grasp] = []
    for face in faces:
        up = -normals[face]
        bottom = float((body.hull.vertices @ up).min())
        level = [pair for pair in pairs if abs(float(pair[1] @ up)) < STEEPEST_CLOSING]
        tried = [level[k] for k in rng.permutation(len(level))[:MAX_PAIRS]]
        scored = [
            (score, grasp)
            for middle, closing, width in tried
            for grasp in _from_above(middle, closing, width, up)
            if (score := _score(grasp, up, bottom, surface, body.hull.centre, part.diameter)) > 0
        ]
        grasps += _select_distinct(scored, each)
    if not grasps:
        raise UserError(
            f"part {part.name}, on which no grasp was found",
            f"opposite walls {1000 * MIN_WIDTH:g} to {1000 * (MAX_OPENING - CLEARANCE):g} mm apart "
            "that are reachable from above",
            "write a file of grasps by hand and pass it with --grasps FILE",
        )
    return tuple(grasps[:count])


def _sample_surface(
    mesh: Mesh, count: int, rng: np.random.Generator
) -> tuple[Points, Points, float]:
    """Return ``count`` uniform random surface points, their unit normals, and m² per point."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, faces = trimesh.sample.sample_surface(solid, count, seed=rng)
    return np.asarray(points), solid.face_normals[faces], float(solid.area) / count


def _pairs(mesh: Mesh, rng: np.random.Generator) -> Iterator[tuple[Vector, Vector, float]]:
    """Yield midpoint, closing direction and width (metres) of antipodal pairs of surface points."""
    points, normals, _ = _sample_surface(mesh, PAIRS, rng)
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    flat = np.cross(b - a, c - a)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    for point, normal in zip(points, normals, strict=True):
        # Faces through which the inward ray may leave the solid, i.e. normals along the ray.
        exits = flat @ -normal > FLAT
        for depth in _hits(point, -normal, a[exits], b[exits], c[exits]):
            if MIN_WIDTH <= depth <= MAX_OPENING - CLEARANCE:
                yield point - depth / 2 * normal, -normal, float(depth)


def _hits(
    origin: Vector, direction: Vector, a: Points, b: Points, c: Points
) -> Float[np.ndarray, "hits"]:
    """Return a ray's distances to triangles (a, b, c) that it hits (Möller and Trumbore 1997)."""
    side, other = b - a, c - a
    across = np.cross(direction, other)
    scale = np.einsum("ij,ij->i", side, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origin - a
        u = np.einsum("ij,ij->i", offset, across) / scale
        flipped = np.cross(offset, side)
        v = flipped @ direction / scale
        depth = np.einsum("ij,ij->i", other, flipped) / scale
    is_hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 1e-5)
    return np.asarray(depth[is_hit])


def _from_above(middle: Vector, closing: Vector, width: float, up: Vector) -> Iterator[Grasp]:
    """Yield the grasps of an antipodal pair with an approach tilted by :data:`TILTS` from down."""
    down = -up + (up @ closing) * closing
    down /= np.linalg.norm(down)
    aside = np.cross(closing, down)
    for tilt in TILTS:
        yield Grasp(middle, closing, math.cos(tilt) * down + math.sin(tilt) * aside, width)


def _score(
    grasp: Grasp,
    up: Vector,
    bottom: float,
    surface: tuple[Points, Points, float],
    centre: Vector,
    diameter: float,
) -> float:
    """Return a grasp's score (at most 1), or 0 if the gripper collides or has too little contact.

    ``bottom`` is the bench's height along ``up``, and ``centre`` the centre of mass, metres.
    """
    points, normals, area = surface
    T = grasp.T_obj_tool(flipped=False)
    half = grasp.width / 2
    # As in the planner, the pads' ends go beyond the point as far as the bench allows.
    spread = abs(float(T[:3, 0] @ up)) * (half + 2 * PAD_HALF[0])
    spread += abs(float(T[:3, 1] @ up)) * PAD_HALF[1]
    room = float(grasp.point @ up) - bottom - spread - ABOVE_BENCH
    if room < 0:
        return 0.0
    ends = grasp.point + min(INSERTIONS[0], room / -float(T[:3, 2] @ up)) * T[:3, 2]
    local, facing = (points - ends) @ T[:3, :3], normals @ T[:3, 0]
    x, y, z = local.T
    is_beside_pad = np.abs(y) < PAD_HALF[1]
    inside = is_beside_pad & (z < 0) & (z > -0.05)
    beyond = np.abs(x)
    blocked = inside & (beyond > half + 0.001) & (beyond < half + CLEARANCE + FINGER)
    palm = ((local > PALM[0]) & (local < PALM[1])).all(axis=1)
    if blocked.any() or palm.any():
        return 0.0
    pad = is_beside_pad & (z < 0) & (z > -4 * PAD_HALF[2])
    contacts = (pad & (np.abs(x - side * half) < 5e-4) & (side * facing > FLAT) for side in (1, -1))
    patches = [area * float(np.count_nonzero(contact)) for contact in contacts]
    if min(patches) < MIN_CONTACT:
        return 0.0
    lever = float(np.linalg.norm(np.cross(centre - grasp.point, grasp.closing))) / diameter
    steep = -float(grasp.approach @ up)
    return max(0.01, min(min(patches) / FULL_CONTACT, 1.0) - lever - 0.5 * (1 - steep))


def _select_distinct(scored: list[tuple[float, Grasp]], count: int) -> list[Grasp]:
    """Return the ``count`` best grasps that differ by at least :data:`DISTINCT`."""
    distance, cosine = DISTINCT[0], math.cos(DISTINCT[1])
    distinct: list[Grasp] = []
    for _, grasp in sorted(scored, key=lambda pair: -pair[0]):
        if len(distinct) == count:
            break
        if not any(
            np.linalg.norm(grasp.point - other.point) < distance
            and abs(grasp.closing @ other.closing) > cosine
            and grasp.approach @ other.approach > cosine
            for other in distinct
        ):
            distinct.append(grasp)
    return distinct
