"""A part's surface as points, and the piece of a depth image that they are laid over.

Checkpoints of parts without a mesh have surface points alone. Every point stands for a disc of the
surface around it. A point is hidden where the discs of others lie before it on its viewing ray.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import cv2
import numpy as np
import scipy  # its parts load when they are used
from jaxtyping import Bool, Float, Int

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, Transform, crop_camera
from dopepp.inference.picture import Depth

Region = Bool[np.ndarray, "height width"]  # some of the pixels

Points = Float[np.ndarray, "points 3"]
Seen = Bool[np.ndarray, "points"]

MOST_POINTS: Final = 3000  # more do not make a refinement better, only slower
FEWEST_POINTS: Final = 100  # fewer do not show a surface
NEIGHBOURS: Final = 12  # points that a normal is estimated from
FLAT: Final = 0.3  # in spacings: neighbours farther off a plane belong to another face

SLIVER: Final = 0.3
"""Twice the area of a triangle, in squared spacings, below which it fixes no plane."""

DISC: Final = 1.5
"""Radius of a point's disc in spacings; of random points, fewer than 1 in 1,000 discs is empty."""

CLEARANCE: Final = 0.4
"""In spacings: what lies this far before a point hides it. About the error of a disc's plane."""

STEEPEST: Final = 0.2
"""Cosine of the angle between ray and normal below which a disc counts as a mere point."""

LONGEST_PX: Final = 112
"""Longer crops are thinned out: ten thousand pixels fix six numbers as well as a million."""

MARGIN: Final = 0.3  # of the part's extent, looked at around it: the pose may be off by as much

NOISE: Final = 2e-3
"""Standard deviation of a depth camera at 1 m, metres; it grows with the square of the depth."""

LEAST_NOISE: Final = 1e-3  # metres: quantisation and distortion, which no sensor is without
GATE: Final = 3.0  # standard deviations within which depth agrees with the part
BESIDE: Final = 6.0  # spacings around the part that are compared with it

EXTENDED: Final = 4.0
"""Spacings by which a point's plane may rise or fall: it does not go on for ever."""

COVERED: Final = 1.0  # spacings around a surface point that count as covered by the part

STEP: Final = 2.0
"""Standard deviations of the depth by which a surface may differ from what it goes on from."""


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


@dataclass(frozen=True, eq=False)
class DepthView:
    """A thinned crop of a depth image: metres along z, float32, 0 where unknown.

    K is of the crop; rays are camera-frame points at z = 1 of its pixels; noise is the standard
    deviation of the depth at the part, metres.
    """

    depth: Depth
    K: CameraMatrix
    rays: Float[np.ndarray, "height width 3"]
    noise: float


def view_around(depth: Depth, K: CameraMatrix, points_cam: Points) -> DepthView | None:
    """Cut out what a part at some pose can have to do with; None outside the image."""
    u, v = (points_cam[:, :2] / points_cam[:, 2:] * K.diagonal()[:2] + K[:2, 2]).T
    edge = MARGIN * max(np.ptp(u), np.ptp(v))
    left, right = max(0, math.floor(u.min() - edge)), math.ceil(u.max() + edge) + 1
    top, bottom = max(0, math.floor(v.min() - edge)), math.ceil(v.max() + edge) + 1
    crop = np.ascontiguousarray(depth[top:bottom, left:right], np.float32)
    if crop.size == 0:
        return None
    step = math.ceil(max(crop.shape) / LONGEST_PX)
    # A median keeps edges, and takes away single wild pixels and half of the noise.
    crop = np.ascontiguousarray(cv2.medianBlur(crop, 3)[::step, ::step])
    own = crop_camera(K, left, top)
    own[:2] /= step
    columns, rows = np.meshgrid(np.arange(crop.shape[1]), np.arange(crop.shape[0]))
    rays = np.stack(
        [(columns - own[0, 2]) / own[0, 0], (rows - own[1, 2]) / own[1, 1], np.ones(crop.shape)], -1
    )
    noise = max(LEAST_NOISE, NOISE * float(points_cam[:, 2].mean()) ** 2)
    return DepthView(crop, own, rays, noise)


@dataclass(frozen=True, eq=False)
class Overlay:
    """A posed part's visible points, laid over a depth view."""

    points: Points  # those within the view, camera frame, metres
    normals: Points  # unit normals of their planes, of either sign
    pixels: Int[np.ndarray, "points 2"]  # column and row of each
    distance: Depth  # of every pixel of the view to the nearest of them, spacings of the part
    nearest: Int[np.ndarray, "height width"]  # index of that point
    # Depth measured less depth predicted by that point's plane, metres; NaN where no depth
    # was measured
    offset: Depth

    @property
    def covered(self) -> Region:
        """Pixels of the part with a measured depth."""
        return np.asarray((self.distance <= COVERED) & np.isfinite(self.offset))

    @property
    def at_points(self) -> Float[np.ndarray, "points"]:
        """The offset at the points' own pixels, metres; NaN where no depth was measured."""
        return np.asarray(self.offset[self.pixels[:, 1], self.pixels[:, 0]])

    def continues(self, noise: float, reach: float) -> Region:
        """Tell pixels beside the part, up to ``reach`` spacings away, that go on as its surface.

        They are compared with the offset of the surface that they would go on, so that a pose that
        is still tilted does not mistake the table for the part. ``noise`` is the depth's, metres.
        """
        beside = (self.distance > COVERED) & (self.distance <= COVERED + reach)
        own = self.at_points
        here = np.where(np.abs(own) <= GATE * noise, own, np.nan)[self.nearest]
        return np.asarray(beside & (np.abs(self.offset - here) <= STEP * noise))


def lay_over(
    view: DepthView, surface: SurfacePoints, seen: Seen, T_cam_obj: Transform
) -> Overlay | None:
    """Relate every pixel of a view to a posed part's nearest visible point; None if none is in it.

    ``seen`` tells which of the part's points the camera sees.
    """
    points = surface.points[seen] @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    normals = surface.normals[seen] @ T_cam_obj[:3, :3].T
    exact = points[:, :2] / points[:, 2:] * view.K.diagonal()[:2] + view.K[:2, 2]
    pixels = np.rint(exact).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < view.depth.shape[::-1])).all(axis=1)
    if not inside.any():
        return None
    points, normals, pixels = points[inside], normals[inside], pixels[inside]
    order = np.argsort(-points[:, 2])  # of two points in one pixel, the nearer one is written last
    free = np.ones(view.depth.shape, np.uint8)
    free[pixels[:, 1], pixels[:, 0]] = 0
    distance, labels = cv2.distanceTransformWithLabels(
        free, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros(int(labels.max()) + 1, np.int64)
    owner[labels[pixels[order, 1], pixels[order, 0]]] = order
    nearest = owner[labels]
    # Below a pixel, the nearest one is covered.
    distance /= max(surface.spacing * view.K[0, 0] / points[:, 2].mean(), 1.0)
    offset = np.empty(view.depth.shape)
    limit = EXTENDED * surface.spacing
    _offsets(view.depth, view.rays, distance, nearest, points, normals, BESIDE, limit, offset)
    return Overlay(points, normals, pixels, distance, nearest, offset)


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


@compiled()
def _offsets(
    depth: Array,
    rays: Array,
    distance: Array,
    nearest: Array,
    points: Array,
    normals: Array,
    farthest: float,
    limit: float,
    offset: Array,
) -> None:
    """Fill ``offset``: each pixel's depth less that of its nearest point's plane, metres.

    It is NaN where the nearest point is beyond ``farthest``. A plane's depth differs from its
    point's by no more than ``limit``.
    """
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            offset[v, u] = np.nan
            if depth[v, u] > 0.0 and distance[v, u] <= farthest:
                j = nearest[v, u]
                z = points[j, 2]
                plane = plane_depth(points[j], normals[j], rays[v, u])
                offset[v, u] = depth[v, u] - min(max(plane, z - limit), z + limit)


@compiled(inline="always")
def plane_depth(point: Array, normal: Array, ray: Array) -> float:
    """Return the depth at which a ray meets a disc's plane; the point's own at a grazing angle."""
    toward = normal[0] * ray[0] + normal[1] * ray[1] + normal[2]
    if abs(toward) < STEEPEST * math.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + 1.0):
        return float(point[2])
    return float((normal[0] * point[0] + normal[1] * point[1] + normal[2] * point[2]) / toward)
