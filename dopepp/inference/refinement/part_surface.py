"""Surface of a part as points, and its comparison with a depth image.

Surface points are used because every checkpoint contains them, also for a part without a mesh. Each
point represents a disc of the surface around it. A point is hidden if the discs of at least two
other points lie in front of it on its viewing ray.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import Final, NamedTuple

import cv2
import numpy as np
import scipy  # SciPy loads its submodules on first use
from jaxtyping import Bool, Float, Int

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, Transform, crop_camera
from dopepp.inference.input_image import Depth

Mask = Bool[np.ndarray, "height width"]  # True at the selected pixels
Points = Float[np.ndarray, "points 3"]
Visible = Bool[np.ndarray, "points"]

# Lengths are in spacings of the surface points unless stated otherwise.
MAX_POINTS: Final = 3000  # further points slow refinement without improving accuracy
MIN_POINTS: Final = 100  # smallest number of points that describe a surface
NEIGHBOURS: Final = 12  # points that a normal is estimated from
FLAT: Final = 0.3  # neighbours farther from a plane belong to another face
SLIVER: Final = 0.3  # twice the area (squared spacings) of a triangle that determines a plane
DISC: Final = 1.5  # radius of a disc: of random points, fewer than 1 in 1,000 discs is empty
CLEARANCE: Final = 0.4  # smallest distance between a point and a disc that hides it
STEEPEST: Final = 0.2  # cosine between ray and normal below which a disc counts as a point
LONGEST_PX: Final = 112  # longer crops are subsampled: 10,000 pixels determine six numbers
MARGIN: Final = 0.3  # margin of a crop, share of the part's extent

NOISE: Final = 2e-3
"""Standard deviation of a depth camera at 1 m, metres; it grows with the square of the depth."""

MIN_NOISE: Final = 1e-3  # metres: quantisation and distortion
GATE: Final = 3.0  # standard deviations within which depth agrees with the part
BESIDE: Final = 6.0  # width of the surroundings that are compared with the part's surface
EXTENDED: Final = 4.0  # largest depth difference between a point and its extended plane
COVERED: Final = 1.0  # distance of a pixel from the nearest point that counts as covered

STEP: Final = 2.0
"""Standard deviations of the depth by which a continued surface may differ from the part."""


class SurfacePoints(NamedTuple):
    """Points on a part's surface in the frame of the object or of the camera, metres."""

    points: Points
    normals: Points  # unit normals of either sign
    spacing: float  # side of the square of surface that a point represents, metres

    def posed(self, T_cam_obj: Transform, chosen: Visible | slice = slice(None)) -> SurfacePoints:
        """Return the chosen points (default: all) in the camera frame."""
        R = T_cam_obj[:3, :3].T
        points = self.points[chosen] @ R + T_cam_obj[:3, 3]
        return SurfacePoints(points, self.normals[chosen] @ R, self.spacing)


def surface_points(points: Points) -> SurfacePoints:
    """Estimate normals and spacing of surface points (object frame, metres).

    Raises:
        ValueError: There are fewer than :data:`MIN_POINTS`.
    """
    if len(points) < MIN_POINTS:
        few = f"{len(points)} points are too few for a surface"
        raise ValueError(f"{few}; at least {MIN_POINTS} are needed")
    points = np.asarray(points, np.float64)
    if len(points) > MAX_POINTS:
        points = points[np.linspace(0, len(points) - 1, MAX_POINTS).astype(int)]
    count = min(NEIGHBOURS + 1, len(points))
    distances, neighbours = map(np.asarray, scipy.spatial.KDTree(points).query(points, count))
    # With ρ points per unit of area, πρr² of them lie within r, one of which is the point itself.
    spacing = float(np.median(distances[:, -1])) * math.sqrt(math.pi / (count - 0.5))
    offsets = (points[neighbours[:, 1:]] - points[:, None]) / spacing
    # The normal belongs to the plane through a point and two neighbours that fits most neighbours:
    # a least-squares plane would mix the two faces of a thin plate.
    best, normals = np.full(len(offsets), np.inf), np.zeros((len(offsets), 3))
    for first, second in combinations(range(offsets.shape[1]), 2):
        normal = np.cross(offsets[:, first], offsets[:, second])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = normal / np.maximum(length, 1e-12)
        cost = np.minimum((offsets @ normal[..., None])[..., 0] ** 2, FLAT**2).sum(axis=1)
        better = (cost < best) & (length[:, 0] > SLIVER)
        best[better], normals[better] = cost[better], normal[better]
    return SurfacePoints(points, normals, spacing)


def visible(surface: SurfacePoints, T_cam_obj: Transform) -> Visible:
    """Return which points are not hidden by the part itself; all must be in front of the camera."""
    posed = surface.posed(T_cam_obj)
    points = posed.points
    rays = points / points[:, 2:]
    # All cells have the size of a disc at the nearest point.
    cell = DISC * surface.spacing / points[:, 2].min()
    keys = np.floor((rays[:, :2] - rays[:, :2].min(axis=0)) / cell).astype(np.int64)
    columns, rows = (keys.max(axis=0) + 1).tolist()
    flat = keys[:, 1] * columns + keys[:, 0]
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(columns * rows + 1))
    is_visible = np.empty(len(points), np.bool_)
    _hide(posed, rays, _Grid(keys, order, starts, columns, rows), is_visible)
    return is_visible


class _Grid(NamedTuple):
    """Points sorted by cells of a grid over the image."""

    keys: Int[np.ndarray, "points 2"]  # column and row of each point's cell
    order: Int[np.ndarray, "points"]  # indices of the points, sorted by cell
    starts: Int[np.ndarray, "cells"]  # position in `order` of each cell's first point
    columns: int
    rows: int


class DepthView(NamedTuple):
    """A subsampled crop of a depth image."""

    depth: Depth  # metres along z, float32, 0 where unknown
    K: CameraMatrix  # camera matrix of the crop
    rays: Float[np.ndarray, "height width 3"]  # camera-frame points of the pixels at z = 1
    noise: float  # standard deviation of the depth at the part, metres


def view_around(depth: Depth, K: CameraMatrix, points_cam: Points) -> DepthView | None:
    """Crop a depth image around a part's points (metres); None if they are outside the image."""
    u, v = (points_cam[:, :2] / points_cam[:, 2:] * K.diagonal()[:2] + K[:2, 2]).T
    margin = MARGIN * max(np.ptp(u), np.ptp(v))
    left, top = (max(0, math.floor(x.min() - margin)) for x in (u, v))
    right, bottom = (max(0, math.ceil(x.max() + margin) + 1) for x in (u, v))
    crop = np.ascontiguousarray(depth[top:bottom, left:right], np.float32)
    if crop.size == 0:
        return None
    step = math.ceil(max(crop.shape) / LONGEST_PX)
    # A median keeps edges, removes single outliers and halves the noise.
    crop = np.ascontiguousarray(cv2.medianBlur(crop, 3)[::step, ::step])
    K = crop_camera(K, left, top)
    K[:2] /= step
    columns, rows = np.meshgrid(np.arange(crop.shape[1]), np.arange(crop.shape[0]))
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    noise = max(MIN_NOISE, NOISE * float(points_cam[:, 2].mean()) ** 2)
    return DepthView(crop, K, np.stack([x, y, np.ones(crop.shape)], -1), noise)


class SurfaceOverlay(NamedTuple):
    """Comparison of a posed part's visible points with a depth view."""

    surface: SurfacePoints  # points within the view, camera frame
    pixels: Int[np.ndarray, "points 2"]  # column and row of each point
    distance: Depth  # distance of every pixel to the nearest point, spacings
    nearest: Int[np.ndarray, "height width"]  # index of that point
    # Measured depth minus the depth of the nearest point's plane, metres; NaN where unknown
    offset: Depth

    @property
    def covered(self) -> Mask:
        """Mask of the pixels that the part covers and that have a measured depth."""
        return np.asarray((self.distance <= COVERED) & np.isfinite(self.offset))

    @property
    def at_points(self) -> Float[np.ndarray, "points"]:
        """Offset at the points' pixels, metres; NaN where unknown."""
        return np.asarray(self.offset[self.pixels[:, 1], self.pixels[:, 0]])

    def continues(self, noise: float, reach: float) -> Mask:
        """Return the pixels next to the part whose depth continues the part's surface.

        A pixel's offset is compared with the offset of the adjacent point, not with 0. Otherwise, a
        table under the part could look like a continuation of a part whose pose is still tilted.

        Args:
            noise: Standard deviation of the depth, metres.
            reach: Width around the part, spacings.
        """
        is_beside = (self.distance > COVERED) & (self.distance <= COVERED + reach)
        at_points = self.at_points
        adjacent = np.where(np.abs(at_points) <= GATE * noise, at_points, np.nan)[self.nearest]
        return np.asarray(is_beside & (np.abs(self.offset - adjacent) <= STEP * noise))


def overlay_surface(
    view: DepthView, surface: SurfacePoints, is_visible: Visible, T_cam_obj: Transform
) -> SurfaceOverlay | None:
    """Compute the depth offset between the measured surface and a posed part, pixel by pixel.

    A pixel is compared with the nearest visible point of the part.

    Args:
        view: Crop of a depth image.
        surface: Points on the part's surface.
        is_visible: Whether each point is visible, i.e. not hidden by the part itself.
        T_cam_obj: Pose of the part.

    Returns:
        The comparison, or None if no visible point lies in the view.
    """
    points, normals, spacing = surface.posed(T_cam_obj, is_visible)
    exact = points[:, :2] / points[:, 2:] * view.K.diagonal()[:2] + view.K[:2, 2]
    pixels = np.rint(exact).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < view.depth.shape[::-1])).all(axis=1)
    if not inside.any():
        return None
    points, pixels = points[inside], pixels[inside]
    order = np.argsort(-points[:, 2])  # the nearer of two points overwrites the farther
    free = np.ones(view.depth.shape, np.uint8)
    free[pixels[:, 1], pixels[:, 0]] = 0
    distance, labels = nearest_zero(free)
    owner = np.zeros(int(labels.max()) + 1, np.int64)
    owner[labels[pixels[order, 1], pixels[order, 0]]] = order
    nearest = owner[labels]
    # If the spacing is below a pixel, the nearest pixel counts as covered.
    distance /= max(spacing * view.K[0, 0] / points[:, 2].mean(), 1.0)
    shown = SurfacePoints(points, normals[inside], spacing)
    overlay = SurfaceOverlay(shown, pixels, distance, nearest, np.empty(view.depth.shape))
    _offsets(view, overlay)
    return overlay


def nearest_zero(mask: Array) -> tuple[Array, Array]:
    """Return each pixel's distance (pixels) to the nearest zero of a mask, and the zero's label."""
    distance, labels = cv2.distanceTransformWithLabels(
        mask, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    return distance, labels


@compiled()
def _hide(posed: SurfacePoints, rays: Array, grid: _Grid, is_visible: Array) -> None:
    """Mark a point as visible if fewer than two discs of other points hide it.

    Args:
        posed: Points of the posed part, camera frame.
        rays: Ray (x/z, y/z) of each point.
        grid: Points by cells, which have the size of a disc at the nearest point.
        is_visible: Filled with whether each point is visible.
    """
    points, normals, spacing = posed
    keys, order, starts, columns, rows = grid
    clearance, reach = CLEARANCE * spacing, DISC * spacing
    for i in range(points.shape[0]):
        z, votes = points[i, 2], 0
        for row in range(max(keys[i, 1] - 1, 0), min(keys[i, 1] + 2, rows)):
            first = starts[row * columns + max(keys[i, 0] - 1, 0)]
            end = starts[row * columns + min(keys[i, 0] + 2, columns)]
            for k in range(first, end):
                j = order[k]
                zj = points[j, 2]
                dx, dy = rays[j, 0] - rays[i, 0], rays[j, 1] - rays[i, 1]
                if zj >= z or (dx * dx + dy * dy) * zj * zj > reach * reach:
                    continue
                # At a convex edge, each extended plane is in front of the other: none is hidden.
                if plane_depth(points[j], normals[j], rays[i]) >= z - clearance:
                    continue
                if plane_depth(points[i], normals[i], rays[j]) > zj + clearance:
                    votes += 1
                    if votes == 2:
                        break
            if votes == 2:
                break
        is_visible[i] = votes < 2


@compiled()
def _offsets(view: DepthView, overlay: SurfaceOverlay) -> None:
    """Write the offsets of an overlay; NaN beyond the surroundings and where depth is unknown."""
    depth, rays = view.depth, view.rays
    (points, normals, spacing), _, distance, nearest, offset = overlay
    limit = EXTENDED * spacing
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            offset[v, u] = np.nan
            if depth[v, u] > 0.0 and distance[v, u] <= BESIDE:
                j = nearest[v, u]
                z = points[j, 2]
                plane = plane_depth(points[j], normals[j], rays[v, u])
                offset[v, u] = depth[v, u] - min(max(plane, z - limit), z + limit)


@compiled(inline="always")
def plane_depth(point: Array, normal: Array, ray: Array) -> float:
    """Return the depth where a ray meets a disc's plane; the point's depth at a grazing angle."""
    toward = normal[0] * ray[0] + normal[1] * ray[1] + normal[2]
    if abs(toward) < STEEPEST * math.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + 1.0):
        return float(point[2])
    return float((normal[0] * point[0] + normal[1] * point[1] + normal[2] * point[2]) / toward)
