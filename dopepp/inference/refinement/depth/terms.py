"""Terms of a depth image: planes of the part's points, and the part's outline in the depth.

Point-to-plane terms: a pixel's residual is its distance from the plane of the visible point that it
shows. Weights decrease to 0 at a limit, so occluders, background and outliers have no effect.

Outline terms move the part across the viewing ray: from points whose measured depth is behind the
part, and towards pixels next to the part whose depth continues the part's surface. Points inside
both outlines have no outline term, because their terms would hold the part in place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import Transform
from dopepp.geometry.rotation import Vector
from dopepp.inference.refinement.part_surface import (
    COVERED,
    GATE,
    DepthView,
    Mask,
    SurfaceOverlay,
    SurfacePoints,
    Visible,
    nearest_zero,
    overlay_surface,
)
from dopepp.inference.refinement.solver import NormalEquations

INDEPENDENT: Final = 100.0
"""Number of independent measurements of a surface, however many pixels show it."""

PLANE_DEVIATION: Final = 0.25  # standard deviation of a point's plane, spacings

Pulls = tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 2"]]
"""Points of the part (camera frame, metres) and their desired motion on the image (pixels)."""


@dataclass(frozen=True, eq=False)
class DepthTerm:
    """Solver term of a depth image at the visible points of a part."""

    view: DepthView
    surface: SurfacePoints
    is_visible: Visible
    reach: float  # distance from a plane above which a pixel has no weight, metres
    outline: float  # like ``reach``, between the outlines, metres; 0 for no outline terms

    def __call__(self, pose: Transform, prior: NormalEquations, /) -> NormalEquations | None:
        """Linearise the term at a pose; None if no point is within the view."""
        view, origin = self.view, pose[:3, 3]
        overlay = overlay_surface(view, self.surface, self.is_visible, pose)
        if overlay is None:
            return None
        H, g = plane_terms(view, overlay, origin, self.reach)
        if not self.outline:
            return H, g
        H_outline, g_outline = outline_terms(view, overlay, origin, self.outline)
        return H + H_outline, g + g_outline


def plane_terms(
    view: DepthView, overlay: SurfaceOverlay, origin: Vector, reach: float
) -> NormalEquations:
    """Return normal equations of a posed part's point-to-plane terms; all lengths are metres.

    Args:
        view: Crop of the depth image.
        overlay: Comparison of the posed part with the depth.
        origin: Object's origin, camera frame.
        reach: Distance from a point's plane above which a pixel has no weight.
    """
    H, g = np.zeros((6, 6)), np.zeros(6)
    count = _add_planes(view, overlay, np.ascontiguousarray(origin), reach, H, g)
    share = min(1.0, INDEPENDENT / max(1.0, count))
    return share * H, share * g


def outline_terms(
    view: DepthView, overlay: SurfaceOverlay, origin: Vector, reach: float
) -> NormalEquations:
    """Return normal equations of the outline terms; see :func:`plane_terms` for the arguments.

    The standard deviation of an outline point's position is the spacing of the points. A point has
    no weight if the measured outline is farther away than ``reach``.
    """
    gate, spacing = GATE * view.noise, overlay.surface.spacing
    offset = overlay.at_points
    in_front = np.flatnonzero((offset > gate) | np.isnan(offset))
    supported = overlay.covered & (np.abs(overlay.offset) <= gate)
    continues = overlay.continues(view.noise, reach / spacing)
    scale = float(overlay.surface.points[:, 2].mean()) / view.K[0, 0]
    # A point represents spacing² of surface, a pixel scale².
    pixel_weight = min(1.0, (scale / spacing) ** 2)
    H, g = np.zeros((6, 6)), np.zeros(6)
    for (points, pulls_px), weight in (
        (_to_surface(overlay, in_front, supported), 1.0),
        (_to_pixels(overlay, continues), pixel_weight),
    ):
        pulls = scale * pulls_px
        near = np.linalg.norm(pulls, axis=1) <= reach
        # A rotation ω moves a point at ``arm`` from the origin by ω × arm.
        x, y, z = (points[near] - origin).T
        zero, unit = np.zeros(len(x)), np.ones(len(x))
        along_x = np.stack([zero, z, -y, unit, zero, zero], 1)
        along_y = np.stack([-z, zero, x, zero, unit, zero], 1)
        for row, pull in zip((along_x, along_y), pulls[near].T, strict=True):
            H += weight / spacing**2 * row.T @ row
            g += weight / spacing**2 * row.T @ pull
    return H, g


def _to_surface(
    overlay: SurfaceOverlay, in_front: Int[np.ndarray, "past"], supported: Mask
) -> Pulls:
    """Return points in front of the measured depth, and shifts to the nearest supported pixels.

    Args:
        overlay: Comparison of the posed part with the depth.
        in_front: Indices of points that lie in front of the measured depth.
        supported: Pixels whose depth agrees with the part.
    """
    if not len(in_front) or not supported.any():
        return np.empty((0, 3)), np.empty((0, 2))
    _, labels = nearest_zero((~supported).astype(np.uint8))
    rows, columns = np.nonzero(supported)
    target = np.zeros((int(labels.max()) + 1, 2))
    target[labels[rows, columns]] = np.stack([columns, rows], axis=1)
    pixels = overlay.pixels[in_front]
    return overlay.surface.points[in_front], target[labels[pixels[:, 1], pixels[:, 0]]] - pixels


def _to_pixels(overlay: SurfaceOverlay, continues: Mask) -> Pulls:
    """Return points next to pixels that continue the part's surface, and shifts towards them.

    Args:
        overlay: Comparison of the posed part with the depth.
        continues: Pixels next to the part whose depth continues its surface.
    """
    rows, columns = np.nonzero(continues)
    nearest = overlay.nearest[rows, columns]
    pulls = np.stack([columns, rows], axis=1) - overlay.pixels[nearest]
    short = 1.0 - COVERED / overlay.distance[rows, columns]
    return overlay.surface.points[nearest], pulls * short[:, None]


@compiled()
def _add_planes(
    view: DepthView, overlay: SurfaceOverlay, origin: Array, reach: float, H: Array, g: Array
) -> float:
    """Add the point-to-plane terms of all pixels that the part covers to the normal equations.

    A rotation ω and a shift τ of the part move a point at ``arm`` from its origin by ω × arm + τ.
    See :func:`plane_terms` for the arguments; ``H`` and ``g`` are updated.

    Returns:
        The sum of the weights.
    """
    depth, _, rays, noise = view
    (points, normals, spacing), _, distance, nearest, _ = overlay
    rough = PLANE_DEVIATION * spacing
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
            # The error of the depth is along the ray.
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
