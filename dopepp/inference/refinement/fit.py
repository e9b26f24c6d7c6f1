"""What decides about a pose beside depth's planes: the image's prior, the fit, and the outline.

The prior is what the RGB image says, a Gaussian around the pose it gave. The fit tells how well a
posed part agrees with a depth image, and when that is too little to believe it.

The outline pulls where a part's point looks past the measured surface, or a pixel beside the part
continues its surface: each such place pulls across the viewing ray. Where the two outlines agree,
nothing pulls, so a surface's inside does not hold the pose back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Int

from dopepp.geometry.camera import Transform, step_between
from dopepp.geometry.rotation import Vector
from dopepp.inference.refinement.view import COVERED, GATE, DepthView, Overlay, lay_over
from dopepp.inference.refinement.visible import PoseMatrix, Region, Seen, SurfacePoints

STEP: Final = 2.0
"""Standard deviations of the depth by which a surface may differ from what it goes on from."""

UNKNOWN_TURN: Final = math.radians(8.0)
UNKNOWN_ACROSS: Final = 0.07
UNKNOWN_ALONG: Final = 0.30
"""Standard deviations of a pose without covariance: radians, and diameters across and along the
viewing ray. An image says little about the distance."""

LEAST_TURN: Final = math.radians(2.0)
LEAST_ACROSS: Final = 0.03
LEAST_ALONG: Final = 0.15
"""Never less, in radians and diameters: calibration and CAD have errors that no image shows, and an
error of the focal length is one of the distance."""

FARTHEST: Final = 3.0
"""Standard deviations (Mahalanobis distance, with the least deviations above) beyond which depth
contradicts the image."""

LEAST_INLIERS: Final = 0.5
"""Of the points with depth that nothing stands before."""

LEAST_SEEN: Final = 0.25
"""Of the visible points that must have agreeing depth at all."""

MOST_RMS: Final = 2.0
"""Standard deviations of the depth: a right pose leaves about one."""

CLOSE: Final = 5.0
"""Spacings before a part up to which nothing else is expected."""

BESIDE: Final = 3.0
"""Spacings around the part in which its surface must not go on."""


@dataclass(frozen=True, eq=False)
class Prior:
    """A pose (metres) and the inverse of its covariance, camera axes, radians and metres.

    That is of (turn about the object's origin, shift).
    """

    T_cam_obj: Transform
    information: PoseMatrix

    def offset(self, T_cam_obj: Transform) -> Float[np.ndarray, "6"]:
        """Return the turn and the shift from a pose to the prior's."""
        return step_between(T_cam_obj, self.T_cam_obj)

    def doubt(self, T_cam_obj: Transform) -> str:
        """Say why a pose contradicts the image; empty where it does not."""
        offset = self.offset(T_cam_obj)
        distance = math.sqrt(max(0.0, float(offset @ self.information @ offset)))
        if distance <= FARTHEST:
            return ""
        return f"{distance:.1f} standard deviations from the image's pose, more than {FARTHEST:g}"


def make_prior(
    T_cam_obj: Transform, diameter: float, covariance: PoseMatrix | None = None
) -> Prior:
    """Return the prior of a pose, with a broad covariance where none, or no finite one, is given.

    The diameter is of the part, metres; the covariance of (turn, shift).
    """
    ray = T_cam_obj[:3, 3] / np.linalg.norm(T_cam_obj[:3, 3])
    along = np.outer(ray, ray)
    floor = LEAST_TURN**2 * np.eye(6)
    floor[3:, 3:] = LEAST_ACROSS**2 * (np.eye(3) - along) + LEAST_ALONG**2 * along
    floor[3:, 3:] *= diameter**2
    if covariance is None or not np.isfinite(covariance).all():
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = UNKNOWN_TURN**2 * np.eye(3)
        shift = UNKNOWN_ACROSS**2 * (np.eye(3) - along) + UNKNOWN_ALONG**2 * along
        covariance[3:, 3:] = diameter**2 * shift
    return Prior(T_cam_obj, np.linalg.inv(np.asarray(covariance, np.float64) + floor))


@dataclass(frozen=True)
class Fit:
    """Agreement of a pose with depth.

    Attributes:
        inliers: Share that agrees among the points with depth that nothing stands before.
        seen: Share that agrees among all points that the part itself does not hide.
        rms: Of the agreeing points' offsets, in standard deviations of the depth.
        uncovered: Area beside the part that goes on as its surface does, over the part's own.
    """

    inliers: float
    seen: float
    rms: float
    uncovered: float

    @property
    def score(self) -> float:
        """One number to compare poses by."""
        return self.seen - (1.0 - self.inliers) - self.uncovered

    def doubt(self, before: Fit) -> str:
        """Say why not to believe this fit rather than the one before; empty where there is none."""
        if self.inliers < LEAST_INLIERS:
            return f"only {self.inliers:.0%} of the part agrees with the depth"
        if self.seen < LEAST_SEEN:
            return f"only {self.seen:.0%} of the part is measured and unobstructed"
        if self.rms > MOST_RMS:
            return f"a residual of {self.rms:.1f} standard deviations of the depth"
        if self.score <= before.score:
            return "the depth fits the given pose no worse"
        return ""


def fit_of(view: DepthView, surface: SurfacePoints, T_cam_obj: Transform, seen: Seen) -> Fit:
    """Measure the agreement of a pose, and of the points it shows, with a depth view."""
    overlay = lay_over(view, surface, seen, T_cam_obj)
    if overlay is None:
        return Fit(0.0, 0.0, np.inf, 0.0)
    gate = GATE * view.noise
    offset = overlay.at_points
    agree = np.abs(offset) <= gate
    # What lies just before a part is more often the part itself, elsewhere, than something else.
    wrong = (offset > gate) | ((offset < -gate) & (offset > -CLOSE * surface.spacing))
    count = int(agree.sum())
    if count == 0:
        return Fit(0.0, 0.0, np.inf, 0.0)
    beside = continues(view, overlay, BESIDE).sum()
    return Fit(
        inliers=count / (count + int(wrong.sum())),
        seen=count / int(seen.sum()),
        rms=float(np.sqrt(np.mean(offset[agree] ** 2))) / view.noise,
        uncovered=float(beside / max(1, (overlay.distance <= 1.0).sum())),
    )


def continues(view: DepthView, overlay: Overlay, reach: float) -> Region:
    """Tell pixels beside a part, up to ``reach`` spacings away, that go on as its surface does.

    They are compared with the offset of the surface that they would go on, so that a pose that is
    still tilted does not mistake the table for the part.
    """
    beside = (overlay.distance > COVERED) & (overlay.distance <= COVERED + reach)
    own = overlay.at_points
    here = np.where(np.abs(own) <= GATE * view.noise, own, np.nan)[overlay.nearest]
    return np.asarray(beside & (np.abs(overlay.offset - here) <= STEP * view.noise))


Terms = tuple[PoseMatrix, Float[np.ndarray, "6"]]
"""Information matrix and vector of (turn about the object's origin, shift), camera axes: H ξ = g.
"""


def outline_terms(
    view: DepthView, overlay: Overlay, origin: Vector, spacing: float, reach: float
) -> Terms:
    """Return the pull of the outline.

    The object's origin is in the camera frame; ``spacing`` is that of the part's points and also
    the standard deviation of a place; ``reach`` is the largest difference between the outlines that
    pulls. All are metres.
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
