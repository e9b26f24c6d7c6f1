"""Depth images as a user gives them, and the part of one that a posed object can belong to.

Depth is in metres along z, aligned to the colour image, and 0 or NaN where it is unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from dopepp.core.compiled import Array, compiled
from dopepp.core.errors import UserError
from dopepp.drawing.pictures import read_image
from dopepp.geometry.camera import CameraMatrix, Transform, crop_camera
from dopepp.inference.refinement.visible import (
    Depth,
    Points,
    Region,
    Seen,
    SurfacePoints,
    plane_depth,
)

Depth32 = Float32[np.ndarray, "height width"]
Coefficients = Float[np.ndarray, "coefficients"]

FARTHEST: Final = 50.0
"""Metres. No depth camera for parts sees so far; millimetres taken for metres do."""

LONGEST_PX: Final = 112
"""Longer crops are thinned out: ten thousand pixels fix six numbers as well as a million."""

MARGIN: Final = 0.3
"""Of the part's extent, looked at around it: the pose may be off by as much."""

NOISE: Final = 2e-3
"""Standard deviation of a depth camera at 1 m, metres; it grows with the square of the depth."""

LEAST_NOISE: Final = 1e-3
"""Metres: quantisation and distortion, which no sensor is without."""

GATE: Final = 3.0
"""Standard deviations within which depth agrees with the part."""

BESIDE: Final = 6.0
"""Spacings around the part that are compared with it."""

EXTENDED: Final = 4.0
"""Spacings by which a point's plane may rise or fall: it does not go on for ever."""

COVERED: Final = 1.0
"""Spacings around a surface point that count as covered by the part."""


def checked_depth(depth: Depth, image_size: tuple[int, int]) -> Depth32:
    """Return depth, metres along z, as float32, 0 where it is unknown (0, NaN or infinite).

    A :class:`UserError`: it is not aligned to a colour image of (width, height), is no array of
    floats, has negative values, or its median cannot be in metres.
    """
    depth = np.asarray(depth)
    if depth.shape != image_size[::-1]:
        raise UserError(
            f"depth of shape {depth.shape} for an image of {image_size[0]}×{image_size[1]}",
            f"one value per pixel, shape {image_size[::-1]}",
            "align the depth to the colour image first",
        )
    if not np.issubdtype(depth.dtype, np.floating):
        fix = "convert it, e.g. depth.astype('float32') / 1000 for millimetres"
        raise UserError(f"depth of type {depth.dtype}", "floats in metres", fix)
    known = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    measured = known[known != 0]
    if measured.size and measured.min() < 0:
        got, fix = (
            f"depth with values down to {measured.min():.4g}",
            "check how the depth was decoded",
        )
        raise UserError(got, "metres along z, 0 where unknown", fix)
    if measured.size and np.median(measured) > FARTHEST:
        raise UserError(
            f"depth with a median of {np.median(measured):.4g} m",
            f"metres, a median of at most {FARTHEST:g}",
            "divide by 1000 if it is in millimetres (or by the camera's own depth scale)",
        )
    return known


def read_depth(path: Path, scale: float) -> Depth32:
    """Read a PNG of 16 bits as metres, 0 where unknown; ``scale`` is metres per unit.

    A :class:`UserError`: the scale is no positive number, or the file is no 16-bit image.
    """
    if not 0 < scale < np.inf:
        fix = "pass 0.001 for millimetres"
        raise UserError(f"depth scale {scale}", "metres per unit, above 0", fix)
    units = read_image(path)
    if units.dtype != np.uint16 or units.ndim != 2:
        raise UserError(
            f"depth image {path} of type {units.dtype} and shape {units.shape}",
            "a PNG with one channel of 16 bits",
            "save the raw depth, not a coloured picture of it",
        )
    return (units * scale).astype(np.float32)


def undistorted_depth(depth: Depth32, K: CameraMatrix, distortion: Coefficients) -> Depth32:
    """Undistort depth as the image is, with each pixel's nearest value: a mean is no surface."""
    size = depth.shape[::-1]
    maps = cv2.initUndistortRectifyMap(K, distortion, np.eye(3), K, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(depth, *maps, cv2.INTER_NEAREST), np.float32)


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

    def points(self, chosen: Region) -> Points:
        """Return the camera-frame points of some pixels, metres."""
        return np.asarray(self.rays[chosen] * self.depth[chosen][:, None])


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
    """A posed part's visible points, laid over a depth view.

    Attributes:
        points: Those within the view, camera frame, metres.
        normals: Unit normals of their planes, of either sign.
        pixels: Column and row of each.
        distance: Of every pixel of the view to the nearest of them, spacings of the part.
        nearest: Index of that point.
        offset: Depth measured less depth predicted by that point's plane, metres; NaN where no
            depth was measured.
    """

    points: Points
    normals: Points
    pixels: Int[np.ndarray, "points 2"]
    distance: Depth
    nearest: Int[np.ndarray, "height width"]
    offset: Depth

    @property
    def covered(self) -> Region:
        """Pixels of the part with a measured depth."""
        return np.asarray((self.distance <= COVERED) & np.isfinite(self.offset))

    @property
    def at_points(self) -> Float[np.ndarray, "points"]:
        """The offset at the points' own pixels, metres; NaN where no depth was measured."""
        return np.asarray(self.offset[self.pixels[:, 1], self.pixels[:, 0]])


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
