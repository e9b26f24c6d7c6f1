"""Rotations that may map a shape onto itself: where to look, and how to aim better.

The shape comes normalised: its surface's centroid at the origin, which every symmetry leaves where
it is, and a diameter of 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.rotation import RotationMatrix, Vector, rotation_vector_to_matrix
from dopepp.parts.mesh.measure import SurfaceTree, half_sphere

_NUM_DIRECTIONS: Final = 1500
"""Axes over half a sphere: none is farther than 2.6° from one of them."""

_MOMENT_TOLERANCE: Final = 0.2
"""Share by which a turn may change the surface's second moments before it is refined: a half turn
that is 2.6° off changes those of a rod by 0.13."""

_ROUGH: Final = 0.06
"""Mean distance, in diameters, from which on a turn is no symmetry seen from 2.6° beside it."""

_NEIGHBOURHOOD: Final = np.radians(8.0)
"""Of the axes within this angle, the best is refined."""

_MOST: Final = 24
"""Axes of one order that are refined; the most that a solid has are 15 (the icosahedron's)."""

_NUM_CLUSTERS: Final = 8
"""Directions of the largest flat areas from which special axes are made."""

_CLUSTER_ANGLE: Final = np.radians(5.0)

_REFINEMENTS: Final = 12
_GIVE: Final = 0.02
"""Distance, in diameters, from which on a point pulls with constant force: it may belong to a
feature that has no counterpart."""

_BETTER: Final = 0.8
"""A special axis is left for the refined one only where this has at most that share of its error:
an axis along an edge is exact."""


def turn(axis: Float[np.ndarray, "*batch 3"], angle: float) -> Float[np.ndarray, "*batch 3 3"]:
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
    """Return axes that are exact where they are right.

    They are the coordinate axes, the principal axes of the moments, the directions of the largest
    flat areas, and these directions' sums, differences and cross products, which are the axes of
    regular solids.
    """
    normals = _main_normals(surface)
    first, second = np.triu_indices(len(normals), 1)
    pairs = normals[first], normals[second]
    axes = np.concatenate(
        [
            np.eye(3), np.linalg.eigh(second_moments(surface))[1].T, normals,
            pairs[0] + pairs[1], pairs[0] - pairs[1], np.cross(*pairs),
        ]
    )  # fmt: skip
    lengths = np.linalg.norm(axes, axis=1)
    return np.asarray(axes[lengths > 0.1] / lengths[lengths > 0.1, None])


def _main_normals(surface: SurfaceTree) -> Float[np.ndarray, "clusters 3"]:
    """Return the directions with the most area, opposite ones as one."""
    # The largest triangles suffice: flat areas that matter have some among them.
    largest = np.argsort(-surface.areas, kind="stable")[:3000]
    normals, areas = surface.normals[largest], surface.areas[largest].copy()
    found: list[Vector] = []
    while len(found) < _NUM_CLUSTERS and areas.any():
        alike = np.abs(normals @ normals[areas.argmax()]) > np.cos(_CLUSTER_ANGLE)
        found.append(normals[areas.argmax()])
        areas[alike] = 0
    return np.array(found)


class Candidates:
    """Axes about which a turn by 2π / order may be a symmetry."""

    def __init__(self, surface: SurfaceTree) -> None:
        self._surface = surface
        self._moments = second_moments(surface)
        self._special = special_axes(surface)
        self._axes = np.concatenate([self._special, half_sphere(_NUM_DIRECTIONS)])
        self._rough_probes = surface.spread(48, seed=1)[0]
        self._probes = surface.spread(400, seed=2)[0]

    def axes(self, order: int) -> Iterator[Vector]:
        """Yield refined axes of a prime order, those with the smallest rough distance first."""
        turns = turn(self._axes, 2 * np.pi / order)
        change = turns @ self._moments @ np.swapaxes(turns, 1, 2) - self._moments
        scale = np.linalg.norm(self._moments)
        possible = np.linalg.norm(change, axis=(1, 2)) <= _MOMENT_TOLERANCE * scale
        index = np.flatnonzero(possible)
        moved = self._rough_probes @ np.swapaxes(turns[index], 1, 2)
        rough = self._surface.distances(moved, neighbours=1).mean(axis=1)
        index, rough = index[rough < _ROUGH], rough[rough < _ROUGH]
        taken: list[Vector] = []
        for number in index[np.argsort(rough, kind="stable")]:
            axis = self._axes[number]
            if taken and np.abs(np.array(taken) @ axis).max() > np.cos(_NEIGHBOURHOOD):
                continue
            taken.append(axis)
            yield self._refined(axis, order, special=number < len(self._special))
            if len(taken) == _MOST:
                return

    def _refined(self, axis: Vector, order: int, special: bool) -> Vector:
        """Aim an axis so that the turned surface lies on the surface as well as it can."""
        rotation = turn(axis, 2 * np.pi / order)
        for _ in range(_REFINEMENTS):
            step = self._step(rotation)
            rotation = turn(step, 1.0) @ rotation
            if np.linalg.norm(step) < 1e-6:  # a thousandth of any tolerance
                break
        # The axis as an eigenvector: a half turn's skew part, which others would give, vanishes.
        better = np.asarray(np.linalg.eigh(rotation + rotation.T)[1][:, -1])
        better = better if better @ axis > 0 else -better
        if special and self._error(better, order) > _BETTER * self._error(axis, order):
            return axis
        return better

    def _step(self, rotation: RotationMatrix) -> Vector:
        """Return the rotation vector that brings the turned points nearest to their planes."""
        moved = self._probes @ rotation.T
        closest, normals = self._surface.nearest(moved)
        away = ((closest - moved) * normals).sum(axis=1)
        weight = np.minimum(1.0, _GIVE / np.maximum(np.abs(away), _GIVE))
        lever = np.cross(moved, normals)
        # The damping stands still in directions that slide the surface along itself.
        normal_matrix = (lever * weight[:, None]).T @ lever + 1e-4 * np.eye(3)
        return np.asarray(np.linalg.solve(normal_matrix, lever.T @ (weight * away)))

    def _error(self, axis: Vector, order: int) -> float:
        moved = self._probes @ turn(axis, 2 * np.pi / order).T
        return float(np.sqrt((self._surface.distances(moved) ** 2).mean()))
