"""Search for the symmetries of a part on its mesh.

A rotation is a symmetry if it moves no point of the surface farther from the surface than a
tolerance, a share of the diameter. Reflections and textures are ignored. The search uses a shape
of diameter 1 about the centroid of its surface, which every symmetry preserves.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.json import cached
from dopepp.geometry.rotation import (
    RotationMatrix,
    Vector,
    rotation_angle,
    rotation_vector_to_matrix,
)
from dopepp.geometry.symmetry import SAME_TURN, ContinuousSymmetry, exact_group, rotations_about
from dopepp.parts.mesh import Points, SurfaceTree, half_sphere, hash_triangles, largest_distance
from dopepp.parts.part import Mesh

_MAX_MEAN: Final = 0.06  # mean distance that excludes a symmetry within 2.6° of the axis, diameters
_HUBER_WIDTH: Final = 0.02
"""Distance above which the loss of a point is linear (Huber), diameters: a feature may lack a
counterpart."""

TOLERANCE: Final = 0.01  # Largest distance from the surface, diameters
LARGEST_TOLERANCE: Final = 0.1
SMALLEST_TOLERANCE: Final = 1e-4

MAX_ORDER: Final = 12  # Highest order of a discrete axis
_NUM_PROBES: Final = 8000
VERSION: Final = 1  # part of the cache's key; increase it when the search changes

Symmetries = tuple[Float[np.ndarray, "symmetries 4 4"], tuple[ContinuousSymmetry, ...]]
_Record = tuple[list[list[list[float]]], tuple[ContinuousSymmetry, ...]]


def cached_symmetries(mesh: Mesh, tolerance: float = TOLERANCE) -> Symmetries:
    """Return the result of :func:`find_symmetries`, which the user's cache folder stores."""

    def make() -> _Record:
        discrete, continuous = find_symmetries(mesh, tolerance)
        return discrete.tolist(), continuous

    key = VERSION, tolerance, hash_triangles(mesh.vertices, mesh.faces)
    discrete, continuous = cached("symmetries", key, _Record, make)
    return np.array(discrete, np.float64).reshape(-1, 4, 4), continuous


def find_symmetries(mesh: Mesh, tolerance: float = TOLERANCE) -> Symmetries:
    """Find the rigid transforms that map a surface onto itself, for any triangulation.

    ``tolerance`` is the largest distance of a moved surface point from the surface, diameters.

    Returns:
        Discrete symmetries without the identity, metres (at most a half turn for a round part),
        and axes of continuous symmetry (three for a ball).

    Raises:
        UserError: ``tolerance`` is outside 1e-4 … 0.1.
    """
    if not SMALLEST_TOLERANCE <= tolerance <= LARGEST_TOLERANCE:
        allowed = f"{SMALLEST_TOLERANCE} – {LARGEST_TOLERANCE} diameters"
        fix = "choose a tolerance in this range"
        raise UserError(f"a tolerance of {tolerance}", allowed, fix)
    shape = _Shape(mesh, tolerance)
    axis, generators = _search(shape)
    if axis is None:
        return shape.transforms(_largest_group(shape, generators)), ()
    across = _across(axis)
    if shape.is_round(across):
        return np.empty((0, 4, 4)), tuple(shape.axis(unit) for unit in np.eye(3))
    flip = axis_rotation(across, np.pi)
    flips = flip[None] if shape.fits(flip) else np.empty((0, 3, 3))
    return shape.transforms(flips), (shape.axis(axis),)


class _Shape:
    """A mesh of diameter 1 about the centroid of its surface, with points that test rotations."""

    def __init__(self, mesh: Mesh, tolerance: float) -> None:
        vertices = np.asarray(mesh.vertices, np.float64)
        used = vertices[np.unique(mesh.faces)]
        self.diameter, self.tolerance = largest_distance(used), tolerance
        middle = used.mean(axis=0)
        scaled = SurfaceTree((vertices - middle) / self.diameter, mesh.faces)
        centroid = scaled.areas @ scaled.triangles.mean(axis=1) / scaled.areas.sum()
        self.centre = middle + self.diameter * centroid
        self.surface = SurfaceTree((vertices - self.centre) / self.diameter, mesh.faces)
        corners = _subset(self.surface.triangles.reshape(-1, 3))
        centres = _subset(self.surface.triangles.mean(axis=1))
        self._few = self.surface.spread(500, seed=3)[0]
        self._many = np.concatenate([corners, centres, self.surface.spread(_NUM_PROBES, seed=4)[0]])

    def fits(self, rotation: RotationMatrix) -> bool:
        """Return whether rotated surface points stay within the tolerance of the surface."""
        for probes in (self._few, self._many):
            moved = probes @ rotation.T
            # One triangle per point is quick and never underestimates; misses are refined.
            rough = self.surface.distances(moved, neighbours=1)
            doubtful = moved[np.argsort(-rough)[: (rough > self.tolerance).sum()]]
            for start in range(0, len(doubtful), 300):
                batch = doubtful[start : start + 300]
                if self.surface.distances(batch, neighbours=48).max() > self.tolerance:
                    return False
        return True

    def is_round(self, axis: Vector) -> bool:
        """Return whether every rotation about an axis through the centre is a symmetry."""
        # For any prism, one of 36 golden-ratio angles is within a few per cent of a side of the
        # worst angle.
        golden = (np.sqrt(5) - 1) / 2
        angles = 2 * np.pi * (golden * np.arange(1, 37) % 1)
        return all(self.fits(axis_rotation(axis, float(angle))) for angle in angles)

    def order(self, axis: Vector, prime: int) -> int:
        """Return the largest multiple of ``prime`` up to 12 that is an order of an axis."""
        orders = range(MAX_ORDER - MAX_ORDER % prime, prime, -prime)
        return next((n for n in orders if self.fits(axis_rotation(axis, 2 * np.pi / n))), prime)

    def transforms(
        self, rotations: Float[np.ndarray, "rotations 3 3"]
    ) -> Float[np.ndarray, "rotations 4 4"]:
        """Return rotations about the centre as transforms of the part, metres."""
        return _round(rotations_about(self.centre, rotations))

    def axis(self, axis: Vector) -> ContinuousSymmetry:
        """Return the symmetry about the line along ``axis`` through the centre.

        The line is given by its direction and by its point nearest the origin, metres.
        """
        offset = self.centre - (self.centre @ axis) * axis
        return tuple(_round(axis).tolist()), tuple(_round(offset).tolist())


def _search(shape: _Shape) -> tuple[Vector | None, list[RotationMatrix]]:
    """Return an axis of continuous symmetry, or None and symmetry rotations by decreasing order."""
    candidates = Candidates(shape.surface)
    generators: list[tuple[int, RotationMatrix]] = []
    group = np.eye(3)[None]
    # Every order up to twelve has one of these factors; the largest finds round shapes first.
    for prime in (11, 7, 5, 3, 2):
        for axis in candidates.axes(prime):
            rotation = axis_rotation(axis, 2 * np.pi / prime)
            away = rotation_angle(rotation @ np.swapaxes(group, 1, 2)).min()
            if away <= SAME_TURN or not shape.fits(rotation):
                continue
            if shape.is_round(axis):
                # The largest coordinate of the axis is made positive.
                return axis * np.sign(axis[np.abs(axis).argmax()]), []
            order = shape.order(axis, prime)
            generators.append((order, axis_rotation(axis, 2 * np.pi / order)))
            larger = exact_group(np.array([generator for _, generator in generators]))
            group = group if larger is None else larger
    generators.sort(key=lambda pair: -pair[0])
    return None, [rotation for _, rotation in generators]


def _largest_group(
    shape: _Shape, generators: list[RotationMatrix]
) -> Float[np.ndarray, "rotations 3 3"]:
    """Return a group of symmetry rotations, built from the generators, without the identity."""
    # Rotations that barely fit are excluded if they generate rotations that do not fit.
    group = np.eye(3)[None]
    for rotation in generators:
        larger = exact_group(np.concatenate([group, rotation[None]]))
        if larger is not None and len(larger) > len(group) and all(map(shape.fits, larger[1:])):
            group = larger
    return group[1:]


class Candidates:
    """Axes about which a rotation by 2π / order may be a symmetry."""

    def __init__(self, surface: SurfaceTree) -> None:
        self._surface = surface
        self._moments = second_moments(surface)
        self._special = special_axes(surface)
        self._axes = np.concatenate([self._special, half_sphere(1500)])  # each 2.6° away at most
        self._rough_probes = surface.spread(48, seed=1)[0]
        self._probes = surface.spread(400, seed=2)[0]

    def axes(self, order: int) -> Iterator[Vector]:
        """Yield refined axes for a prime order, by increasing distance error before refinement."""
        R = axis_rotation(self._axes, 2 * np.pi / order)
        change = R @ self._moments @ np.swapaxes(R, 1, 2) - self._moments
        scale = np.linalg.norm(self._moments)
        # A half turn about an axis off by 2.6° changes the moments of a rod by 13 %.
        possible = np.linalg.norm(change, axis=(1, 2)) <= 0.2 * scale
        index = np.flatnonzero(possible)
        moved = self._rough_probes @ np.swapaxes(R[index], 1, 2)
        rough = self._surface.distances(moved, neighbours=1).mean(axis=1)
        index, rough = index[rough < _MAX_MEAN], rough[rough < _MAX_MEAN]
        taken: list[Vector] = []
        for number in index[np.argsort(rough, kind="stable")]:
            axis = self._axes[number]
            # Among axes within 8°, only the best is refined.
            if taken and np.abs(np.array(taken) @ axis).max() > np.cos(np.radians(8.0)):
                continue
            taken.append(axis)
            yield self._refine(axis, order, special=number < len(self._special))
            if len(taken) == 24:  # the icosahedron has the most, 15
                return

    def _refine(self, axis: Vector, order: int, special: bool) -> Vector:
        """Refine an axis so that a rotation by 2π / order maps the surface best onto itself."""
        rotation = axis_rotation(axis, 2 * np.pi / order)
        for _ in range(12):
            step = self._step(rotation)
            rotation = axis_rotation(step, 1.0) @ rotation
            if np.linalg.norm(step) < 1e-6:  # a thousandth of any tolerance
                break
        # The axis is an eigenvector, because the skew part of a half turn vanishes.
        refined = np.asarray(np.linalg.eigh(rotation + rotation.T)[1][:, -1])
        refined = refined if refined @ axis > 0 else -refined
        # Special axes, e.g. along edges, are exact, so only a much smaller error replaces them.
        if special and self._error(refined, order) > 0.8 * self._error(axis, order):
            return axis
        return refined

    def _step(self, rotation: RotationMatrix) -> Vector:
        """Return the rotation vector of a damped least-squares step on point-to-plane distances."""
        moved = self._probes @ rotation.T
        closest, normals = self._surface.nearest(moved)
        offsets = ((closest - moved) * normals).sum(axis=1)
        weight = np.minimum(1.0, _HUBER_WIDTH / np.maximum(np.abs(offsets), _HUBER_WIDTH))
        lever = np.cross(moved, normals)
        # Damping prevents steps that slide the surface along itself.
        normal_matrix = (lever * weight[:, None]).T @ lever + 1e-4 * np.eye(3)
        return np.asarray(np.linalg.solve(normal_matrix, lever.T @ (weight * offsets)))

    def _error(self, axis: Vector, order: int) -> float:
        """Return the RMS distance of the rotated surface points from the surface, diameters."""
        moved = self._probes @ axis_rotation(axis, 2 * np.pi / order).T
        return float(np.sqrt((self._surface.distances(moved) ** 2).mean()))


def axis_rotation(
    axis: Float[np.ndarray, "*batch 3"], angle: float
) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotation by an angle (radians) about a unit axis."""
    return rotation_vector_to_matrix(angle * axis)


def second_moments(surface: SurfaceTree) -> Float[np.ndarray, "3 3"]:
    """Return the mean of x·xᵀ over the surface, exactly."""
    corners = surface.triangles
    sums = corners.sum(axis=1)
    # Over a triangle the mean of x·xᵀ is (Σ vᵢvᵢᵀ + s·sᵀ)/12 with s = Σ vᵢ.
    products = np.einsum("nki,nkj->nij", corners, corners) + sums[:, :, None] * sums[:, None]
    return np.asarray(np.tensordot(surface.areas, products / 12, axes=1) / surface.areas.sum())


def special_axes(surface: SurfaceTree) -> Float[np.ndarray, "axes 3"]:
    """Return the coordinate axes, eigenvectors of the second moments and normals of large areas.

    Sums, differences and cross products of normals are the axes of regular solids.
    """
    normals = _main_normals(surface)
    first, second = np.triu_indices(len(normals), 1)
    pairs = normals[first], normals[second]
    moment_axes = np.linalg.eigh(second_moments(surface))[1].T
    combinations = pairs[0] + pairs[1], pairs[0] - pairs[1], np.cross(*pairs)
    axes = np.concatenate([np.eye(3), moment_axes, normals, *combinations])
    lengths = np.linalg.norm(axes, axis=1)
    return np.asarray(axes[lengths > 0.1] / lengths[lengths > 0.1, None])


def _main_normals(surface: SurfaceTree) -> Float[np.ndarray, "clusters 3"]:
    """Return up to 8 normals of the largest triangles, over 5° apart; their sign is ignored."""
    # The largest triangles suffice, as relevant flat areas have large triangles.
    largest = np.argsort(-surface.areas, kind="stable")[:3000]
    normals, areas = surface.normals[largest], surface.areas[largest].copy()
    directions: list[Vector] = []
    while len(directions) < 8 and areas.any():
        alike = np.abs(normals @ normals[areas.argmax()]) > np.cos(np.radians(5.0))
        directions.append(normals[areas.argmax()])
        areas[alike] = 0
    return np.array(directions)


def _across(axis: Vector) -> Vector:
    nearest = np.eye(3)[np.abs(axis).argmin()]
    across = nearest - (nearest @ axis) * axis
    return np.asarray(across / np.linalg.norm(across))


def _subset(points: Points) -> Float[np.ndarray, "subset 3"]:
    """Return at most ``_NUM_PROBES`` of the points, evenly spaced."""
    return points[:: -(-len(points) // _NUM_PROBES)]


def _round(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Round to 12 decimals, and replace −0 by 0."""
    return np.asarray(np.round(values, 12) + 0.0)
