"""Which points of a part a camera sees, from its surface points alone: checkpoints hold no mesh.

Every point stands for a disc of the surface around it. A point is hidden where the discs of others
lie before it on its viewing ray.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
import scipy  # its parts load when they are used
from jaxtyping import Bool, Float

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import Transform

Depth = Float[np.ndarray, "height width"]
Region = Bool[np.ndarray, "height width"]
"""Metres along z of every pixel, and some of the pixels."""

Points = Float[np.ndarray, "points 3"]
Seen = Bool[np.ndarray, "points"]
PoseMatrix = Float[np.ndarray, "6 6"]
"""Covariance or information of a turn (radians) and a shift (metres)."""

MOST_POINTS: Final = 3000
"""More do not make a refinement better, only slower."""

FEWEST_POINTS: Final = 100
"""Fewer do not show a surface."""

NEIGHBOURS: Final = 12
"""Points that a normal is estimated from."""

FLAT: Final = 0.3
"""In spacings: neighbours farther off a plane belong to another face."""

SLIVER: Final = 0.3
"""Twice the area of a triangle, in squared spacings, below which it fixes no plane."""

DISC: Final = 1.5
"""Radius of a point's disc in spacings; of random points, fewer than 1 in 1,000 discs is empty."""

CLEARANCE: Final = 0.4
"""In spacings: what lies this far before a point hides it. About the error of a disc's plane."""

STEEPEST: Final = 0.2
"""Cosine of the angle between ray and normal below which a disc counts as a mere point."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points spread over a part's surface, object frame, metres, and unit normals of either sign.

    ``spacing`` is the side of the square of surface that a point stands for, metres.
    """

    points: Points
    normals: Points
    spacing: float


def surface_points(points: Points) -> SurfacePoints:
    """Estimate the normals and the spacing of surface points (object frame, metres).

    Fewer than :data:`FEWEST_POINTS` are a ``ValueError``.
    """
    if len(points) < FEWEST_POINTS:
        raise ValueError(f"{len(points)} points are no surface, {FEWEST_POINTS} are needed")
    points = np.asarray(points, np.float64)
    if len(points) > MOST_POINTS:
        points = points[np.linspace(0, len(points) - 1, MOST_POINTS).astype(int)]
    count = min(NEIGHBOURS + 1, len(points))
    found = scipy.spatial.KDTree(points).query(points, count)
    distances, neighbours = np.asarray(found[0]), np.asarray(found[1])
    # Of a surface with ρ points a unit of area, πρr² lie within r; the point itself is one of them.
    spacing = float(np.median(distances[:, -1])) * math.sqrt(math.pi / (count - 0.5))
    offsets = points[neighbours[:, 1:]] - points[:, None]
    return SurfacePoints(points, _normals(offsets / spacing), spacing)


def _normals(offsets: Float[np.ndarray, "points near 3"]) -> Points:
    """Return the normal of the plane through each point and two neighbours that most others fit.

    A plane of least squares would mix the two faces of a thin plate. Offsets are from each point to
    its neighbours, in spacings.
    """
    best = np.full(len(offsets), np.inf)
    normals = np.zeros((len(offsets), 3))
    for one, other in combinations(range(offsets.shape[1]), 2):
        across = np.cross(offsets[:, one], offsets[:, other])
        length = np.linalg.norm(across, axis=1, keepdims=True)
        across = across / np.maximum(length, 1e-12)
        off = np.minimum((offsets @ across[..., None])[..., 0] ** 2, FLAT**2).sum(axis=1)
        # A sliver of a triangle says nothing of its plane.
        better = (off < best) & (length[:, 0] > SLIVER)
        best[better], normals[better] = off[better], across[better]
    return normals


def visible(surface: SurfacePoints, T_cam_obj: Transform) -> Seen:
    """Tell which points no other part of the surface hides; all are in front of the camera."""
    points = surface.points @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    normals = surface.normals @ T_cam_obj[:3, :3].T
    rays = points / points[:, 2:]
    # One size of cell for all: a disc of the nearest point.
    cell = DISC * surface.spacing / points[:, 2].min()
    keys = np.floor((rays[:, :2] - rays[:, :2].min(axis=0)) / cell).astype(np.int64)
    columns, rows = (keys.max(axis=0) + 1).tolist()
    flat = keys[:, 1] * columns + keys[:, 0]
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(columns * rows + 1))
    seen = np.empty(len(points), np.bool_)
    _look(points, normals, rays, keys, order, starts, columns, rows, surface.spacing, seen)
    return seen


@compiled()
def _look(
    points: Array,
    normals: Array,
    rays: Array,
    keys: Array,
    order: Array,
    starts: Array,
    columns: int,
    rows: int,
    spacing: float,
    seen: Array,
) -> None:
    """Compare every point with the discs around its ray; two of them have to agree.

    Points lie in a grid over the image: ``keys`` are the column and row of each one's cell,
    ``order`` the points by cell, and ``starts`` where each cell begins there. ``seen`` is filled.
    """
    clearance, reach = CLEARANCE * spacing, DISC * spacing
    for i in range(points.shape[0]):
        z, votes = points[i, 2], 0
        for row in range(max(keys[i, 1] - 1, 0), min(keys[i, 1] + 2, rows)):
            first = starts[row * columns + max(keys[i, 0] - 1, 0)]
            end = starts[row * columns + min(keys[i, 0] + 2, columns)]
            for place in range(first, end):
                j = order[place]
                zj = points[j, 2]
                dx, dy = rays[j, 0] - rays[i, 0], rays[j, 1] - rays[i, 1]
                if zj >= z or (dx * dx + dy * dy) * zj * zj > reach * reach:
                    continue
                # At a convex edge either plane, extended, lies before the other: nothing is hidden.
                if plane_depth(points[j], normals[j], rays[i]) >= z - clearance:
                    continue
                if plane_depth(points[i], normals[i], rays[j]) > zj + clearance:
                    votes += 1
                    if votes == 2:
                        break
            if votes == 2:
                break
        seen[i] = votes < 2


@compiled(inline="always")
def plane_depth(point: Array, normal: Array, ray: Array) -> float:
    """Return the depth at which a ray meets a disc's plane; the point's own at a grazing angle."""
    toward = normal[0] * ray[0] + normal[1] * ray[1] + normal[2]
    if abs(toward) < STEEPEST * math.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + 1.0):
        return float(point[2])
    return float((normal[0] * point[0] + normal[1] * point[1] + normal[2] * point[2]) / toward)
