"""Point-to-plane terms: measured depth pulls the planes of a part's points onto itself.

A pixel's residual is its distance from the plane of the visible point that it falls on. What
differs by more than a reach pulls nothing, and less the nearer it comes to that: an occluder, a
background and a wild pixel say nothing of the part, and neither does a pixel without depth.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.rotation import Vector
from dopepp.inference.refinement.fit import Terms
from dopepp.inference.refinement.view import COVERED, DepthView, Overlay

INDEPENDENT: Final = 100.0
"""So many independent measurements stand behind any number of neighbouring pixels."""

ROUGH: Final = 0.25
"""Of the part's spacing: standard deviation of a point's plane."""


def plane_terms(
    view: DepthView, overlay: Overlay, origin: Vector, spacing: float, reach: float
) -> Terms:
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
