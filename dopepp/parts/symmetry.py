"""The symmetries of a part, found on its mesh.

A rotation is a symmetry when it takes no point of the surface farther from the surface than a
tolerance, a share of the diameter. Mirror images are none: no motion makes one out of a part.
Texture is not looked at.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import RotationMatrix, Vector, rotation_angle
from dopepp.geometry.symmetry import SAME_TURN, ContinuousSymmetry, exact_group
from dopepp.parts.mesh.measure import Points, SurfaceTree, largest_distance
from dopepp.parts.part import Mesh
from dopepp.parts.symmetry_candidates import Candidates, turn

TOLERANCE: Final = 0.01
"""Share of the diameter by which a symmetry may miss the surface."""

LARGEST_TOLERANCE: Final = 0.1
SMALLEST_TOLERANCE: Final = 1e-4

MAX_ORDER: Final = 12
"""Turns in a full one about an axis of discrete symmetry, at most."""

_PRIMES: Final = (11, 7, 5, 3, 2)
"""Every axis of up to twelve turns has one of these. The largest first: it finds round shapes."""

_NUM_ANGLES: Final = 36
"""Turns that tell a round shape, spread over all angles by the golden ratio, so that they hit the
worst angle of a prism with any number of sides within a few per cent of a side."""

_NUM_PROBES: Final = 8000
_CLOSER_LOOK: Final = 48
"""Triangles that a point is measured against before it is said to miss the surface."""
_AT_A_TIME: Final = 300
_DIGITS: Final = 12

Symmetries = tuple[Float[np.ndarray, "symmetries 4 4"], tuple[ContinuousSymmetry, ...]]


def find_symmetries(mesh: Mesh, tolerance: float = TOLERANCE) -> Symmetries:
    """Find the rigid transforms that map a mesh onto itself.

    Args:
        mesh: The part's triangles, metres; how a surface is cut into triangles does not matter.
        tolerance: Largest distance of a moved surface point from the surface, in diameters.

    Returns:
        The discrete symmetries without the identity, metres: with the identity they form a group,
        and a round part's flip stands for all its flips. And the axes of continuous symmetry as
        (axis, offset), three for a ball.

    Raises:
        UserError: The tolerance is not in 1e-4 … 0.1.
    """
    if not SMALLEST_TOLERANCE <= tolerance <= LARGEST_TOLERANCE:
        raise UserError(
            f"a tolerance of {tolerance}", f"{SMALLEST_TOLERANCE} – {LARGEST_TOLERANCE} diameters",
            "choose how far a symmetry may miss the surface",
        )  # fmt: skip
    shape = _Shape(mesh, tolerance)
    axis, generators = _search(shape)
    if axis is None:
        return shape.transforms(_largest_group(shape, generators)), ()
    across = _across(axis)
    if shape.is_round(across):
        return np.empty((0, 4, 4)), tuple(shape.axis(unit) for unit in np.eye(3))
    flip = turn(across, np.pi)
    flips = flip[None] if shape.fits(flip) else np.empty((0, 3, 3))
    return shape.transforms(flips), (shape.axis(axis),)


class _Shape:
    """A mesh about its surface's centroid with a diameter of 1, and points to try turns on."""

    def __init__(self, mesh: Mesh, tolerance: float) -> None:
        vertices = np.asarray(mesh.vertices, np.float64)
        used = vertices[np.unique(mesh.faces)]
        self.diameter, self.tolerance = largest_distance(used), tolerance
        middle = used.mean(axis=0)
        scaled = SurfaceTree((vertices - middle) / self.diameter, mesh.faces)
        centroid = scaled.areas @ scaled.triangles.mean(axis=1) / scaled.areas.sum()
        self.centre = middle + self.diameter * centroid
        self.surface = SurfaceTree((vertices - self.centre) / self.diameter, mesh.faces)
        corners = _some(self.surface.triangles.reshape(-1, 3))
        centres = _some(self.surface.triangles.mean(axis=1))
        self._few = self.surface.spread(500, seed=3)[0]
        self._many = np.concatenate([corners, centres, self.surface.spread(_NUM_PROBES, seed=4)[0]])

    def fits(self, rotation: RotationMatrix) -> bool:
        """Tell whether the turned surface lies on the surface."""
        for probes in (self._few, self._many):
            moved = probes @ rotation.T
            # One triangle a point is quick, and never too near; what misses it gets a closer look,
            # the farthest first.
            rough = self.surface.distances(moved, neighbours=1)
            doubtful = moved[np.argsort(-rough)[: (rough > self.tolerance).sum()]]
            for start in range(0, len(doubtful), _AT_A_TIME):
                some = doubtful[start : start + _AT_A_TIME]
                if self.surface.distances(some, _CLOSER_LOOK).max() > self.tolerance:
                    return False
        return True

    def is_round(self, axis: Vector) -> bool:
        """Tell whether every turn about an axis fits."""
        golden = (np.sqrt(5) - 1) / 2
        angles = 2 * np.pi * (golden * np.arange(1, _NUM_ANGLES + 1) % 1)
        return all(self.fits(turn(axis, float(angle))) for angle in angles)

    def order(self, axis: Vector, prime: int) -> int:
        """Return the most equal turns about an axis that fit, a multiple of a prime."""
        orders = range(MAX_ORDER - MAX_ORDER % prime, prime, -prime)
        return next((n for n in orders if self.fits(turn(axis, 2 * np.pi / n))), prime)

    def transforms(
        self, rotations: Float[np.ndarray, "rotations 3 3"]
    ) -> Float[np.ndarray, "rotations 4 4"]:
        """Return rotations about the centre as transforms of the part, metres."""
        shifts = self.centre - rotations @ self.centre
        pairs = zip(rotations, shifts, strict=True)
        return _clean(np.array([make_transform(*pair) for pair in pairs]).reshape(-1, 4, 4))

    def axis(self, axis: Vector) -> ContinuousSymmetry:
        """Return an axis through the centre with the point on it that is nearest the origin."""
        offset = self.centre - (self.centre @ axis) * axis
        return tuple(_clean(axis).tolist()), tuple(_clean(offset).tolist())


def _search(shape: _Shape) -> tuple[Vector | None, list[RotationMatrix]]:
    """Return the first axis of continuous symmetry, or None and rotations that fit."""
    candidates = Candidates(shape.surface)
    generators: list[tuple[int, RotationMatrix]] = []
    group = np.eye(3)[None]
    for prime in _PRIMES:
        for axis in candidates.axes(prime):
            rotation = turn(axis, 2 * np.pi / prime)
            away = rotation_angle(rotation @ np.swapaxes(group, 1, 2)).min()
            if away <= SAME_TURN or not shape.fits(rotation):
                continue
            if shape.is_round(axis):
                return _signed(axis), []
            order = shape.order(axis, prime)
            generators.append((order, turn(axis, 2 * np.pi / order)))
            known = exact_group(np.array([one for _, one in generators]))
            group = group if known is None else known
    generators.sort(key=lambda pair: -pair[0])
    return None, [rotation for _, rotation in generators]


def _largest_group(
    shape: _Shape, generators: list[RotationMatrix]
) -> Float[np.ndarray, "rotations 3 3"]:
    """Return a group of rotations that all fit, without the identity."""
    # A rotation that fits only just may bring others with it that do not; then it is left out.
    group = np.eye(3)[None]
    for rotation in generators:
        larger = exact_group(np.concatenate([group, rotation[None]]))
        if larger is not None and len(larger) > len(group) and all(map(shape.fits, larger[1:])):
            group = larger
    return group[1:]


def _across(axis: Vector) -> Vector:
    """Return a direction across an axis, a coordinate axis where one is."""
    nearest = np.eye(3)[np.abs(axis).argmin()]
    across = nearest - (nearest @ axis) * axis
    return np.asarray(across / np.linalg.norm(across))


def _signed(axis: Vector) -> Vector:
    """Point an axis so that its largest coordinate is positive."""
    return axis if axis[np.abs(axis).argmax()] > 0 else -axis


def _some(points: Points) -> Float[np.ndarray, "some 3"]:
    """Return at most ``_NUM_PROBES`` of the points, evenly."""
    return points[:: -(-len(points) // _NUM_PROBES)]


def _clean(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Round away what sine and cosine leave of zeros and ones."""
    return np.asarray(np.round(values, _DIGITS) + 0.0)
