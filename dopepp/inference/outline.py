"""How the outline of a part in a depth image pulls on its pose.

Where a part's point looks past the measured surface, or a pixel beside the part continues its
surface, the two outlines differ; each such place pulls across the viewing ray. Where they agree,
nothing pulls, so a surface's inside does not hold the pose back.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.inference.depth_view import COVERED, GATE, DepthView, Overlay

STEP: Final = 2.0
"""Standard deviations of the depth by which a surface may differ from what it goes on from."""

Terms = tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6"]]
"""Information matrix and vector of (turn about the object's origin, shift): H ξ = g."""


def continues(view: DepthView, overlay: Overlay, reach: float) -> Bool[np.ndarray, "height width"]:
    """Tell pixels beside a part, up to ``reach`` spacings away, that go on as its surface does.

    They are compared with the offset of the surface that they would go on, so that a pose that is
    still tilted does not mistake the table for the part.
    """
    beside = (overlay.distance > COVERED) & (overlay.distance <= COVERED + reach)
    own = overlay.at_points
    here = np.where(np.abs(own) <= GATE * view.noise, own, np.nan)[overlay.nearest]
    return np.asarray(beside & (np.abs(overlay.offset - here) <= STEP * view.noise))


def outline_terms(
    view: DepthView,
    overlay: Overlay,
    origin: Float[np.ndarray, "3"],
    spacing: float,
    reach: float,
) -> Terms:
    """Return the pull of the outline.

    Args:
        view: The depth.
        overlay: The part on it.
        origin: The object's origin, camera frame, metres.
        spacing: Of the part's points, metres; also the standard deviation of a place.
        reach: Largest difference between the outlines, metres.
    """
    gate = GATE * view.noise
    offset = overlay.at_points
    past = np.flatnonzero((offset > gate) | np.isnan(offset))
    supported = overlay.covered & (np.abs(overlay.offset) <= gate)
    beside = continues(view, overlay, reach / spacing)
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


def _to_surface(
    overlay: Overlay, past: Int[np.ndarray, "past"], supported: Bool[np.ndarray, "height width"]
) -> Pulls:
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


def _to_pixels(overlay: Overlay, beside: Bool[np.ndarray, "height width"]) -> Pulls:
    """Pull the points nearest to uncovered surface until they cover it."""
    rows, columns = np.nonzero(beside)
    nearest = overlay.nearest[rows, columns]
    pulls = np.stack([columns, rows], axis=1) - overlay.pixels[nearest]
    short = 1.0 - COVERED / overlay.distance[rows, columns]
    return overlay.points[nearest], pulls * short[:, None]


def _add(
    H: Float[np.ndarray, "6 6"],
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
