"""Where a part can be gripped: a few lines of YAML a part, best grasps first.

.. code-block:: yaml

    part: bracket
    grasps:
    - {point: [0.0, 0.0, 0.002], closing: [1, 0, 0], approach: [0, 0, -1], width: 0.03}

``point`` is the middle between the fingers, ``closing`` the direction along which they close,
``approach`` the one in which the gripper comes, ``width`` the part's between them: the part's frame
and metres.

:func:`propose_grasps` finds grasps of any mesh: opposite places of its surface that two fingers
reach from above. Points of the surface are paired with those behind them along the normal; pairs
whose normals are opposite within the pads' friction are antipodal (Nguyen 1988). Each is tried on
every face that the part can lie on: approached from above, with nothing where fingers and palm go.
What is kept has much of the surface under both pads and is close to the centre of mass.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from jaxtyping import Bool, Float

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, write_whole
from dopepp.core.validation import STRICT, Range, parse
from dopepp.core.yaml import read_yaml
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.rotation import Vector
from dopepp.parts.part import Mesh, Part
from dopepp.virtual.body import make_body

MAX_GRASPS: Final = 1000
WIDEST: Final = 0.085  # metres that the fingers open (2F-85)
CLEARANCE: Final = 0.006
"""Metres between each finger and the part as the fingers come down, where they open so far."""

PAD_HALF: Final = np.array([0.004, 0.011, 0.009375])
"""Half a finger pad's thickness, width and length (2F-85; a finger has two, one behind the other),
metres."""

INSERTIONS: Final = (0.009, 0.003)
"""How far the pads' ends go beyond a grasp's point, where there is room, metres: half a pad, or no
deeper than what lies below may allow."""

ABOVE_BENCH: Final = 0.001  # metres that the pads' ends keep from the bench
PAIRS: Final = 1500  # points of the surface at which pairs are looked for
FACES: Final = 8  # faces, the commonest, on which a part may lie
TRIED: Final = 100  # pairs that are tried on every face
SAMPLES: Final = 5000  # points that stand for the surface where fingers are to go and to press
THINNEST: Final = 0.002  # metres between the pads below which nothing is gripped
FRICTION_ANGLE: Final = math.radians(15.0)
"""Largest angle between the normals and the closing direction; friction 0.6 holds up to 31°."""

STEEPEST_CLOSING: Final = math.sin(math.radians(37.0))
"""Largest share of a closing direction that is upwards."""

TILTS: Final = np.radians([0.0, 25.0, -25.0])
"""Of an approach from straight down, about the closing direction."""

ENOUGH: Final = 80e-6  # square metres under a pad from which on more is no better: a fifth of it
LEAST: Final = 12e-6  # square metres under each pad that hold a part
FINGER: Final = 0.025  # how thick a finger is behind its pad, metres
PALM: Final = np.array([[-0.075, -0.04, -0.16], [0.075, 0.04, -0.055]])
"""Corners of the gripper's body, in the frame of the pads' ends, metres."""

APART: Final = (0.008, math.radians(20.0))
"""Grasps of one face are at least so far apart, metres, or their approaches so turned."""

_BUILT_IN: Final = Path(__file__).parent / "data"
Points = Float[np.ndarray, "n 3"]

FIX: Final = "correct it, or write one with `dopepp grasp propose`"


@dataclass(frozen=True, eq=False)
class Grasp:
    """One way to grip a part; see the module."""

    point: Vector
    closing: Vector
    approach: Vector
    width: float

    @property
    def opening(self) -> float:
        """How far the fingers are apart as they come, metres."""
        return min(self.width + 2 * CLEARANCE, WIDEST)

    def T_obj_tool(self, turned: bool) -> Transform:  # noqa: N802
        """Return the tool's pose: x closes, z comes; ``turned`` by half a turn about z."""
        x = -self.closing if turned else self.closing
        return make_transform(
            np.stack([x, np.cross(self.approach, x), self.approach], axis=1), self.point
        )


def find_grasps(part: Part, path: Path | None = None) -> tuple[Grasp, ...]:
    """Return a part's grasps from a file or the built-in ones.

    Raises:
        UserError: The file is no file of this part's grasps, or there is none.
    """
    chosen = path or _BUILT_IN / f"{part.name}.yaml"
    if path is None and not chosen.is_file():
        raise UserError(
            f"part {part.name} without a grasp", "a file of grasps for every part that is not "
            "built in", f"dopepp grasp propose {part.name}.stl --out {part.name}.yaml, then "
            f"--grasps {part.name}.yaml",
        )  # fmt: skip
    return read_grasps(chosen, part)


@dataclass(frozen=True)
class _GraspRecord:
    __pydantic_config__ = STRICT

    point: tuple[float, float, float]
    closing: tuple[float, float, float]
    approach: tuple[float, float, float]
    width: Annotated[float, Range(1e-4, WIDEST, "metres")]


@dataclass(frozen=True)
class _GraspFile:
    __pydantic_config__ = STRICT

    part: str
    grasps: list[_GraspRecord]


def read_grasps(path: Path, part: Part) -> tuple[Grasp, ...]:
    """Read a file of grasps.

    Raises:
        UserError: The file is no file of grasps, or is one of another part.
    """
    content = parse(_GraspFile, read_yaml(path), str(path), FIX)
    if content.part != part.name:
        raise UserError(f"{path}, part: {content.part!r:.100}", f"part: {part.name}", FIX)
    if not 0 < len(content.grasps) <= MAX_GRASPS:
        got = f"{path}, part {part.name} with {len(content.grasps)} grasps"
        raise UserError(got, f"1 to {MAX_GRASPS} grasps", FIX)
    return tuple(
        _checked(record, f"{path}.grasps[{number}]", part)
        for number, record in enumerate(content.grasps)
    )


def _checked(record: _GraspRecord, name: str, part: Part) -> Grasp:
    point, closing, approach = map(np.array, (record.point, record.closing, record.approach))
    lower, upper = part.cuboid.min(axis=0) - 0.01, part.cuboid.max(axis=0) + 0.01
    if not ((point >= lower) & (point <= upper)).all():
        raise UserError(f"{name}.point={list(record.point)}", "a point of the part, metres", FIX)
    lengths = [float(np.linalg.norm(direction)) for direction in (closing, approach)]
    if min(lengths) < 1e-6 or abs(closing @ approach) > 0.02 * lengths[0] * lengths[1]:
        raise UserError(name, "closing and approach at a right angle", FIX)
    z = approach / lengths[1]
    x = closing - (closing @ z) * z
    return Grasp(point, x / np.linalg.norm(x), z, record.width)


def write_grasps(path: Path, part: Part, grasps: Sequence[Grasp]) -> None:
    """Write a file of grasps, a line each."""
    check_target(path, (".yaml", ".yml"))
    lines = [f"part: {part.name}", "grasps:"]
    for grasp in grasps:
        vectors = ", ".join(
            f"{name}: [{', '.join(map(_written, getattr(grasp, name)))}]"
            for name in ("point", "closing", "approach")
        )
        lines.append(f"- {{{vectors}, width: {_written(grasp.width)}}}")
    write_whole(path, ("\n".join(lines) + "\n").encode())


def _written(value: float) -> str:
    """Return a number with five decimals at most; YAML takes one with an exponent for text."""
    number = round(value, 5) + 0.0  # makes −0 of rounding a 0
    return f"{number:.5f}".rstrip("0").rstrip(".")


def propose_grasps(part: Part, count: int, seed: int = 0) -> tuple[Grasp, ...]:
    """Return up to so many grasps of a part, those of its commonest resting face first.

    A :class:`UserError`: the part has no mesh, or no grasp was found.
    """
    body = make_body(part, is_target=True)
    assert part.mesh is not None
    rng = np.random.default_rng(seed)
    normals, shares = body.hull.rests
    pairs = list(_pairs(part.mesh, rng))
    surface = _sampled(part.mesh, SAMPLES, rng)
    faces = np.argsort(-shares, kind="stable")[:FACES]
    each = math.ceil(count / len(faces))
    found: list[Grasp] = []
    for face in faces:
        up = -normals[face]
        bottom = float((body.hull.vertices @ up).min())
        level = [pair for pair in pairs if abs(float(pair[1] @ up)) < STEEPEST_CLOSING]
        tried = [level[k] for k in rng.permutation(len(level))[:TRIED]]
        scored = [
            (score, grasp)
            for middle, closing, width in tried
            for grasp in _from_above(middle, closing, width, up)
            if (score := _score(grasp, up, bottom, surface, body.hull.centre, part.diameter)) > 0
        ]
        found += _apart(scored, each)
    if not found:
        raise UserError(
            f"part {part.name}, on which no grasp was found",
            f"opposite walls {1000 * THINNEST:g} to {1000 * (WIDEST - CLEARANCE):g} mm apart that "
            "are reached from above", "write its grasps by hand, for another gripper or fixture",
        )  # fmt: skip
    return tuple(found[:count])


def _sampled(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[Points, Points, float]:
    """Return points spread over the surface, their normals, and the area of each, m²."""
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1) / 2
    chosen = rng.choice(len(areas), count, p=areas / areas.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points = a[chosen] + u[:, None] * (b - a)[chosen] + v[:, None] * (c - a)[chosen]
    return points, normals[chosen] / (2 * areas[chosen, None]), float(areas.sum()) / count


def _pairs(mesh: Mesh, rng: np.random.Generator) -> Iterator[tuple[Vector, Vector, float]]:
    """Yield middles, closing directions and widths of antipodal pairs."""
    points, normals, _ = _sampled(mesh, PAIRS, rng)
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    flat = np.cross(b - a, c - a)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    for point, normal in zip(points, normals, strict=True):
        # Where the ray inwards leaves the solid through a face that looks along it.
        leaves = flat @ -normal > math.cos(FRICTION_ANGLE)
        for depth in _hits(point, -normal, a[leaves], b[leaves], c[leaves]):
            if THINNEST <= depth <= WIDEST - CLEARANCE:
                yield point - depth / 2 * normal, -normal, float(depth)


def _hits(
    origin: Vector, direction: Vector, a: Points, b: Points, c: Points
) -> Float[np.ndarray, "hits"]:
    """Return at which depths a ray meets triangles (Möller and Trumbore 1997)."""
    side, other = b - a, c - a
    across = np.cross(direction, other)
    scale = np.einsum("ij,ij->i", side, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = origin - a
        u = np.einsum("ij,ij->i", away, across) / scale
        turned = np.cross(away, side)
        v = turned @ direction / scale
        depth = np.einsum("ij,ij->i", other, turned) / scale
    met = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 1e-5)
    return np.asarray(depth[met])


def _from_above(middle: Vector, closing: Vector, width: float, up: Vector) -> Iterator[Grasp]:
    """Yield grasps of a pair whose approaches are close to straight down."""
    down = -up + (up @ closing) * closing
    down /= np.linalg.norm(down)
    aside = np.cross(closing, down)
    for tilt in TILTS:
        yield Grasp(middle, closing, math.cos(tilt) * down + math.sin(tilt) * aside, width)


def _score(
    grasp: Grasp, up: Vector, bottom: float, surface: tuple[Points, Points, float],
    centre: Vector, diameter: float,
) -> float:  # fmt: skip
    """Return how good a grasp is of a part that lies with ``up`` upwards; 0 where it is none."""
    points, normals, area = surface
    T = grasp.T_obj_tool(turned=False)
    half = grasp.width / 2
    # As the planner does it: the pads' ends go beyond the point as far as the bench allows.
    spread = abs(float(T[:3, 0] @ up)) * (half + 2 * PAD_HALF[0])
    spread += abs(float(T[:3, 1] @ up)) * PAD_HALF[1]
    room = float(grasp.point @ up) - bottom - spread - ABOVE_BENCH
    if room < 0:
        return 0.0
    ends = grasp.point + min(INSERTIONS[0], room / -float(T[:3, 2] @ up)) * T[:3, 2]
    at, facing = (points - ends) @ T[:3, :3], normals @ T[:3, 0]
    inside = (np.abs(at[:, 1]) < PAD_HALF[1]) & (at[:, 2] < 0) & (at[:, 2] > -0.05)
    beyond = np.abs(at[:, 0])
    blocked = inside & (beyond > half + 0.001) & (beyond < half + CLEARANCE + FINGER)
    palm = ((at > PALM[0]) & (at < PALM[1])).all(axis=1)
    if blocked.any() or palm.any():
        return 0.0
    touched = _touched(at, facing, half)
    patches = [area * float(np.count_nonzero(side)) for side in touched]
    if min(patches) < LEAST:
        return 0.0
    lever = float(np.linalg.norm(np.cross(centre - grasp.point, grasp.closing))) / diameter
    steep = -float(grasp.approach @ up)
    return max(0.01, min(min(patches) / ENOUGH, 1.0) - lever - 0.5 * (1 - steep))


def _touched(
    at: Points, facing: Float[np.ndarray, "n"], half: float
) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Tell which points of the surface lie against the pads."""
    pad = (np.abs(at[:, 1]) < PAD_HALF[1]) & (at[:, 2] < 0) & (at[:, 2] > -4 * PAD_HALF[2])
    flat = math.cos(FRICTION_ANGLE)
    right = pad & (np.abs(at[:, 0] - half) < 5e-4) & (facing > flat)
    left = pad & (np.abs(at[:, 0] + half) < 5e-4) & (facing < -flat)
    return left, right


def _apart(scored: list[tuple[float, Grasp]], count: int) -> list[Grasp]:
    """Return the best that are not much the same."""
    kept: list[Grasp] = []
    for _, grasp in sorted(scored, key=lambda one: -one[0]):
        if len(kept) == count:
            break
        if not any(_is_alike(grasp, one) for one in kept):
            kept.append(grasp)
    return kept


def _is_alike(first: Grasp, second: Grasp) -> bool:
    near = float(np.linalg.norm(first.point - second.point)) < APART[0]
    axis = abs(float(first.closing @ second.closing)) > math.cos(APART[1])
    approach = float(first.approach @ second.approach) > math.cos(APART[1])
    return near and axis and approach
