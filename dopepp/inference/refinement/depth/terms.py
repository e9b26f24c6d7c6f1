"""The terms of a depth image: planes of the part's points, and the part's outline in the depth.

Point-to-plane terms: measured depth pulls the planes of a part's points onto itself.

A pixel's residual is its distance from the plane of the visible point that it falls on. What
differs by more than a reach pulls nothing, and less the nearer it comes to that: an occluder, a
background and a wild pixel say nothing of the part, and neither does a pixel without depth.

The outline pulls where a part's point looks past the measured surface, or a pixel beside the part
continues its surface: each such place pulls across the viewing ray. Where the two outlines agree,
nothing pulls, so a surface's inside does not hold the pose back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Int

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import Transform
from dopepp.geometry.rotation import Vector
from dopepp.inference.refinement.solver import NormalEquations, PoseMatrix
from dopepp.inference.refinement.surface import (
    COVERED,
    GATE,
    DepthView,
    Overlay,
    Region,
    Seen,
    SurfacePoints,
    lay_over,
)

INDEPENDENT: Final = 100.0
"""So many independent measurements stand behind any number of neighbouring pixels."""

ROUGH: Final = 0.25  # of the part's spacing: standard deviation of a point's plane


@dataclass(frozen=True, eq=False)
class DepthTerm:
    """The pull of depth on the points of a part that are seen."""

    view: DepthView  # the depth
    surface: SurfacePoints  # the part's points
    seen: Seen  # which of them the camera sees
    reach: float  # largest distance from a plane that pulls, metres
    outline: float  # largest difference of outlines that pulls, metres; 0 leaves the outline out

    def __call__(self, pose: Transform, known: NormalEquations) -> NormalEquations | None:
        """Return the pull at a pose; None where no point is within the view."""
        view, origin, spacing = self.view, pose[:3, 3], self.surface.spacing
        overlay = lay_over(view, self.surface, self.seen, pose)
        if overlay is None:
            return None
        H, g = plane_terms(view, overlay, origin, spacing, self.reach)
        if not self.outline:
            return H, g
        H_outline, g_outline = outline_terms(view, overlay, origin, spacing, self.outline)
        return H + H_outline, g + g_outline


def plane_terms(
    view: DepthView, overlay: Overlay, origin: Vector, spacing: float, reach: float
) -> NormalEquations:
    """Return the pull of the depth on a posed part's surface.

    The object's origin is in the camera frame; ``spacing`` is that of the part's points; ``reach``
    is the largest difference that pulls. All are metres.
    """
    H, g = np.zeros((6, 6)), np.zeros(6)
    count = _add_planes(
        view.depth, view.rays, overlay.distance, overlay.nearest, overlay.points, overlay.normals,
        np.ascontiguousarray(origin), reach, view.noise, ROUGH * spacing, H, g,
    )  # fmt: skip
    share = min(1.0, INDEPENDENT / max(1.0, count))
    return share * H, share * g


def outline_terms(
    view: DepthView, overlay: Overlay, origin: Vector, spacing: float, reach: float
) -> NormalEquations:
    """Return the pull of the outline.

    The object's origin is in the camera frame; ``spacing`` is that of the part's points and also
    the standard deviation of a place; ``reach`` is the largest difference between the outlines that
    pulls. All are metres.
    """
    gate = GATE * view.noise
    offset = overlay.at_points
    past = np.flatnonzero((offset > gate) | np.isnan(offset))
    supported = overlay.covered & (np.abs(overlay.offset) <= gate)
    beside = overlay.continues(view.noise, reach / spacing)
    pairs = [_to_surface(overlay, past, supported), _to_pixels(overlay, beside)]
    depth = float(overlay.points[:, 2].mean())
    scale = depth / view.K[0, 0]
    # A point stands for spacing² of surface, a pixel for scale².
    weights = (1.0, min(1.0, (scale / spacing) ** 2))
    H, g = np.zeros((6, 6)), np.zeros(6)
    for (points, pulls_px), weight in zip(pairs, weights, strict=True):
        pulls = scale * pulls_px
        near = np.linalg.norm(pulls, axis=1) <= reach
        _add(H, g, points[near] - origin, pulls[near], weight / spacing**2)
    return H, g


Pulls = tuple[Float[np.ndarray, "places 3"], Float[np.ndarray, "places 2"]]
"""Places on the part, camera frame, and where they should go from there, pixels."""


def _to_surface(overlay: Overlay, past: Int[np.ndarray, "past"], supported: Region) -> Pulls:
    """Pull points that look past the surface to the nearest pixel of it."""
    if not len(past) or not supported.any():
        return np.empty((0, 3)), np.empty((0, 2))
    _, labels = cv2.distanceTransformWithLabels(
        (~supported).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    rows, columns = np.nonzero(supported)
    place = np.zeros((int(labels.max()) + 1, 2))
    place[labels[rows, columns]] = np.stack([columns, rows], axis=1)
    own = overlay.pixels[past]
    return overlay.points[past], place[labels[own[:, 1], own[:, 0]]] - own


def _to_pixels(overlay: Overlay, beside: Region) -> Pulls:
    """Pull the points nearest to uncovered surface until they cover it."""
    rows, columns = np.nonzero(beside)
    nearest = overlay.nearest[rows, columns]
    pulls = np.stack([columns, rows], axis=1) - overlay.pixels[nearest]
    short = 1.0 - COVERED / overlay.distance[rows, columns]
    return overlay.points[nearest], pulls * short[:, None]


def _add(
    H: PoseMatrix,
    g: Float[np.ndarray, "6"],
    arms: Float[np.ndarray, "places 3"],
    pulls: Float[np.ndarray, "places 2"],
    weight: float,
) -> None:
    """Add the terms of places that should move by ``pulls`` along x and y.

    A turn ω moves a place at ``arm`` from the origin by ω × arm.
    """
    zero, one = np.zeros(len(arms)), np.ones(len(arms))
    x, y, z = arms.T
    for row, pull in (
        (np.stack([zero, z, -y, one, zero, zero], 1), pulls[:, 0]),
        (np.stack([-z, zero, x, zero, one, zero], 1), pulls[:, 1]),
    ):
        H += weight * row.T @ row
        g += weight * row.T @ pull


@compiled()
def _add_planes(
    depth: Array,
    rays: Array,
    distance: Array,
    nearest: Array,
    points: Array,
    normals: Array,
    origin: Array,
    reach: float,
    noise: float,
    rough: float,
    H: Array,
    g: Array,
) -> float:
    """Add the terms of all pixels that the part covers; return how many count, by their weights.

    A turn ω and a shift τ of the part move a place at ``arm`` from its origin by ω × arm + τ.
    """
    row = np.empty(6)
    total = 0.0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            if z <= 0.0 or distance[v, u] > COVERED:
                continue
            point, normal, ray = points[nearest[v, u]], normals[nearest[v, u]], rays[v, u]
            residual, slope = 0.0, 0.0
            for a in range(3):
                residual += normal[a] * (z * ray[a] - point[a])
                slope += normal[a] * ray[a]
            if abs(residual) >= reach:
                continue
            weight = (1.0 - (residual / reach) ** 2) ** 2
            total += weight
            # The depth's error is one along the ray.
            weight /= rough * rough + (noise * slope) ** 2
            x = z * ray[0] - residual * normal[0] - origin[0]
            y = z * ray[1] - residual * normal[1] - origin[1]
            w = z * ray[2] - residual * normal[2] - origin[2]
            row[0] = y * normal[2] - w * normal[1]
            row[1] = w * normal[0] - x * normal[2]
            row[2] = x * normal[1] - y * normal[0]
            row[3:] = normal
            for a in range(6):
                g[a] += weight * residual * row[a]
                for b in range(6):
                    H[a, b] += weight * row[a] * row[b]
    return total
