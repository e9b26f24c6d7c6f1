"""Perspective-n-point: nine or fewer keypoints and K in, one trustworthy pose or a reason out.

OpenCV supplies the closed-form start (SQPnP); our own part is what it lacks: per-point standard
deviations, robust weights, the mirrored start that thin plates need, and checks that no returned
pose is NaN, behind the camera or at a wild distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float

from dopepp.geometry.camera import make_transform, project, transform
from dopepp.geometry.rotation import is_rotation, rotation_vector_to_matrix

MIN_POINTS: Final = 4
GATE: Final = 3.0
"""Points beyond this many standard deviations are outliers (99.7 % of a Gaussian lies within)."""

NUM_SUBSET_STARTS: Final = 3
"""How many of the poses from subsets are worth refining."""

MAX_DISTANCE: Final = 500.0
"""Farthest believable pose in object sizes: with a focal length of 1,000 px that is 2 px wide."""


@dataclass(frozen=True)
class PnPResult:
    """A pose, or the reason for having none.

    Attributes:
        T_cam_obj: Object-to-camera transform in metres; None when there is no trustworthy pose.
        reprojection_error_px: RMS distance over the inliers, pixels; infinite without a pose.
        inliers: Which of the given points agree with the pose within :data:`GATE`.
        reason: Why there is no pose; empty when there is one.
    """

    T_cam_obj: Float[np.ndarray, "4 4"] | None
    reprojection_error_px: float
    inliers: Bool[np.ndarray, "n"]
    reason: str = ""


def solve_pnp(
    object_points: Float[np.ndarray, "n 3"],
    image_points: Float[np.ndarray, "n 2"],
    K: Float[np.ndarray, "3 3"],
    sigma_px: Float[np.ndarray, "n"] | float = 1.0,
) -> PnPResult:
    """Estimate a pose from point correspondences, tolerating missing and wild points.

    Args:
        object_points: Points in the object frame, metres.
        image_points: Their pixels; a row with NaN is a missing point.
        K: Camera matrix, pixels.
        sigma_px: Standard deviation of each pixel position (isotropic), pixels.

    Returns:
        The pose with the smallest robust cost among the refined starts: SQPnP on all points, its
        mirror image and, where outliers show, SQPnP on all but one and all but two points.
    """
    object_points = np.asarray(object_points, np.float64)
    image_points = np.asarray(image_points, np.float64)
    sigma = np.broadcast_to(np.asarray(sigma_px, np.float64), len(object_points))
    usable = np.isfinite(object_points).all(1) & np.isfinite(image_points).all(1)
    usable &= np.isfinite(sigma) & (sigma > 0)
    none = np.zeros(len(object_points), bool)
    reason = _degenerate(object_points[usable], image_points[usable])
    if reason:
        return PnPResult(None, np.inf, none, reason)

    points = _Correspondences(object_points[usable], image_points[usable], K, sigma[usable])
    refined = [points.refine(start) for start in _starts(points)]
    candidates = [T for T in refined if not points.implausible(T)]
    if not candidates:
        return PnPResult(None, np.inf, none, "no start led to a pose in front of the camera")
    best = min(candidates, key=points.cost)
    residuals = points.residuals_px(best)
    agree = residuals <= GATE * points.sigma
    if agree.sum() < MIN_POINTS:
        reason = f"only {int(agree.sum())} points agree on one pose, {MIN_POINTS} are needed"
        return PnPResult(None, np.inf, none, reason)
    inliers = none.copy()
    inliers[np.flatnonzero(usable)[agree]] = True
    return PnPResult(best, float(np.sqrt(np.mean(residuals[agree] ** 2))), inliers)


def _degenerate(
    object_points: Float[np.ndarray, "n 3"], image_points: Float[np.ndarray, "n 2"]
) -> str:
    """Say why these points cannot fix a pose, or return an empty string."""
    if len(object_points) < MIN_POINTS:
        return f"only {len(object_points)} points, {MIN_POINTS} are needed"
    object_spread = np.linalg.svd(object_points - object_points.mean(0), compute_uv=False)
    if object_spread[1] < 1e-6 * max(object_spread[0], 1e-12):
        return "the object points lie on one line"
    distinct = len(np.unique(np.round(image_points, 3), axis=0))
    if distinct < MIN_POINTS:
        return f"only {distinct} distinct pixels, {MIN_POINTS} are needed"
    image_spread = np.linalg.svd(image_points - image_points.mean(0), compute_uv=False)
    if image_spread[1] < 1e-3 * image_spread[0]:
        return "the pixels lie on one line"
    return ""


class _Correspondences:
    """Weighted correspondences with the robust cost that all candidate poses are judged by."""

    def __init__(
        self,
        object_points: Float[np.ndarray, "n 3"],
        image_points: Float[np.ndarray, "n 2"],
        K: Float[np.ndarray, "3 3"],
        sigma: Float[np.ndarray, "n"],
    ) -> None:
        self.object_points, self.image_points = object_points, image_points
        self.K, self.sigma = np.asarray(K, np.float64), sigma
        self.size = float(np.linalg.norm(np.ptp(object_points, axis=0)))

    def residuals_px(self, T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n"]:
        """Reprojection distance per point; infinite behind the camera."""
        difference = project(transform(T, self.object_points), self.K) - self.image_points
        distance = np.hypot(difference[:, 0], difference[:, 1])
        return np.where(np.isfinite(distance), distance, np.inf)

    def cost(self, T: Float[np.ndarray, "4 4"]) -> float:
        """Truncated squared error in units of sigma (MSAC): an outlier costs the gate."""
        return float(np.minimum((self.residuals_px(T) / self.sigma) ** 2, GATE**2).sum())

    def implausible(self, T: Float[np.ndarray, "4 4"]) -> bool:
        """Tell a broken pose: not finite, not a rotation, behind the camera or far too far."""
        if not np.isfinite(T).all() or not is_rotation(T[:3, :3]):
            return True
        depth = transform(T, self.object_points)[:, 2]
        return bool(depth.min() <= 0 or np.linalg.norm(T[:3, 3]) > MAX_DISTANCE * self.size)

    def refine(self, T: Float[np.ndarray, "4 4"], steps: int = 15) -> Float[np.ndarray, "4 4"]:
        """Minimise the Geman–McClure cost by damped Gauss–Newton on SE(3)."""
        damping, value = 1e-4, self._robust_cost(T)
        for _ in range(steps):
            hessian, gradient = self._normal_equations(T)
            if not np.isfinite(hessian).all():
                return T
            scaled = hessian + damping * np.diag(np.diag(hessian) + 1e-12)
            step = -np.linalg.lstsq(scaled, gradient, rcond=None)[0]
            moved = _exp(step, T)
            new_value = self._robust_cost(moved)
            if new_value < value:
                converged = value - new_value < 1e-9 * value
                T, value, damping = moved, new_value, damping / 10
                if converged:
                    break
            elif damping > 1e6:
                break
            else:
                damping *= 10
        return T

    def _robust_cost(self, T: Float[np.ndarray, "4 4"]) -> float:
        squared = (self.residuals_px(T) / self.sigma) ** 2
        with np.errstate(invalid="ignore"):
            return float(np.where(np.isinf(squared), 1.0, squared / (squared + GATE**2)).sum())

    def _normal_equations(
        self, T: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6"]]:
        """Gauss–Newton system for a left increment (rotation vector, translation)."""
        rotated = self.object_points @ T[:3, :3].T
        x, y, z = (rotated + T[:3, 3]).T
        fx, fy = self.K[0, 0], self.K[1, 1]
        zero = np.zeros_like(z)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_point = np.stack(
                [
                    np.stack(
                        [fx / z, zero + self.K[0, 1] / z, -(fx * x + self.K[0, 1] * y) / z**2], 1
                    ),
                    np.stack([zero, fy / z, -fy * y / z**2], 1),
                ],
                1,
            )
        # d(Exp(ω) p)/dω = −[p]×, so a row a of the Jacobian becomes −a [p]× = p × a.
        by_rotation = np.cross(rotated[:, None, :], by_point)
        jacobian = np.concatenate([by_rotation, by_point], axis=2)
        residual = project(rotated + T[:3, 3], self.K) - self.image_points
        squared = (residual**2).sum(1) / self.sigma**2
        # Geman–McClure's weight: the derivative of r²/(r² + g²) with respect to r².
        weight = GATE**2 / (squared + GATE**2) ** 2 / self.sigma**2
        weighted = jacobian * weight[:, None, None]
        return (
            np.einsum("nij,nik->jk", weighted, jacobian),
            np.einsum("nij,ni->j", weighted, residual),
        )


def _exp(
    increment: Float[np.ndarray, "6"], T: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Rotate a pose about its own origin and shift it: the update of the normal equations."""
    rotation = rotation_vector_to_matrix(increment[:3]) @ T[:3, :3]
    return make_transform(rotation, T[:3, 3] + increment[3:])


def _starts(points: _Correspondences) -> list[Float[np.ndarray, "4 4"]]:
    """Return start poses: from all points, its mirror, and the best ones that leave outliers out.

    Solving a subset costs a tenth of refining it, so all subsets are solved and few are refined.
    """
    everything = np.arange(len(points.object_points))
    whole = _sqpnp(points, everything)
    starts = [] if whole is None else [whole, _mirrored(whole)]
    if whole is not None and (points.residuals_px(whole) <= GATE * points.sigma).all():
        return starts
    subsets = [
        start
        for left_out in (1, 2)
        if len(everything) - left_out >= MIN_POINTS
        for kept in combinations(everything, len(everything) - left_out)
        for start in (_sqpnp(points, np.array(kept)),)
        if start is not None
    ]
    return starts + sorted(subsets, key=points.cost)[:NUM_SUBSET_STARTS]


def _sqpnp(points: _Correspondences, kept: np.ndarray) -> Float[np.ndarray, "4 4"] | None:
    """Solve a subset with OpenCV's SQPnP; None where it raises or returns no finite pose."""
    object_points, image_points = points.object_points[kept], points.image_points[kept]
    try:
        found, rotation_vector, translation = cv2.solvePnP(
            object_points, image_points, points.K, None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # OpenCV 5 raises on coincident points
        return None
    if not found or not np.isfinite(rotation_vector).all() or not np.isfinite(translation).all():
        return None
    rotation = rotation_vector_to_matrix(rotation_vector.ravel())
    return make_transform(rotation, translation.ravel())


def _mirrored(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the other tilt under which a plate looks almost the same.

    Seen from far away, a plate tilted by +θ and by −θ about the same axis have the same image. The
    second is the first reflected in the plane across the viewing ray, R' = S R diag(1, 1, −1) with
    S = I − 2rrᵀ: two reflections, so a rotation. The plate's normal is the object's z axis.
    """
    ray = T[:3, 3] / np.linalg.norm(T[:3, 3])
    reflection = np.eye(3) - 2 * np.outer(ray, ray)
    return make_transform(reflection @ T[:3, :3] @ np.diag([1.0, 1.0, -1.0]), T[:3, 3])
