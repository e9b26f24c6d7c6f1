"""Perspective-n-point: nine or fewer keypoints and K in, one trustworthy pose or a reason out.

OpenCV supplies the closed-form start (SQPnP); our own part is what it lacks: per-point
covariances, robust weights, the pose's own covariance, the mirrored start that thin plates need,
and checks that no returned pose is NaN, behind the camera or at a wild distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float

from dopepp.geometry.camera import make_transform
from dopepp.geometry.refine import GATE, NO_GATE, Correspondences, Poses, refine
from dopepp.geometry.rotation import is_rotation, rotation_vector_to_matrix

MIN_POINTS: Final = 4

MOST_LEFT_OUT: Final = 2
"""Outliers looked for by leaving points out; the robust cost bears more where these are mild."""

NUM_STARTS: Final = 3
"""How many of the poses from subsets are worth refining."""

MAX_DISTANCE: Final = 500.0
"""Farthest believable pose in object sizes: with a focal length of 1,000 px that is 2 px wide."""

SMALLEST: Final = 1e-9
LARGEST: Final = 1e9
"""Extent of the object points, metres, outside of which they are no object."""

MAX_TANGENT: Final = 1000.0
"""Distance from the principal point in focal lengths: 89.9° off the axis, where no pixel is."""

PLATE: Final = 0.3
"""Thickness over length up to which a part's mirrored tilt is tried as a start of its own."""

_NO_CAMERA: Final = np.eye(3)


@dataclass(frozen=True)
class PnPResult:
    """A pose, or the reason for having none.

    Attributes:
        T_cam_obj: Object-to-camera transform in metres; None when there is no trustworthy pose.
        reprojection_error_px: RMS distance over the inliers, pixels; infinite without a pose.
        inliers: Which of the given points agree with the pose within
            :data:`~dopepp.geometry.refine.GATE` standard deviations.
        reason: Why there is no pose; empty when there is one.
        covariance: Of a small turn of the object about its origin (rotation vector in the camera
            frame, radians) and a small shift (camera frame, metres), from the inliers'
            covariances; None without a pose.
    """

    T_cam_obj: Float[np.ndarray, "4 4"] | None
    reprojection_error_px: float
    inliers: Bool[np.ndarray, "n"]
    reason: str = ""
    covariance: Float[np.ndarray, "6 6"] | None = None


def solve_pnp(
    object_points: Float[np.ndarray, "n 3"],
    image_points: Float[np.ndarray, "n 2"],
    K: Float[np.ndarray, "3 3"],
    sigma_px: Float[np.ndarray, "n"] | float = 1.0,
    covariance_px: Float[np.ndarray, "n 2 2"] | None = None,
) -> PnPResult:
    """Estimate a pose from point correspondences, tolerating missing and wild points.

    Args:
        object_points: Points in the object frame, metres.
        image_points: Their pixels; a row with NaN is a missing point.
        K: Camera matrix, pixels; it may have skew.
        sigma_px: Standard deviation of each pixel position (isotropic), pixels; a point whose
            deviation is not finite and positive is missing.
        covariance_px: Covariance of each pixel position, pixels²; where given it replaces
            ``sigma_px``. A point whose covariance is not finite and positive definite is missing.

    Returns:
        The pose with the smallest robust cost among the refined starts: SQPnP on all points, its
        mirror image for a plate and, where outliers show, SQPnP on all but one and all but two.

    Raises:
        ValueError: The arguments differ in length, or K is no invertible pinhole matrix.
    """
    object_points = np.asarray(object_points, np.float64).reshape(-1, 3)
    image_points = np.asarray(image_points, np.float64).reshape(-1, 2)
    if len(object_points) != len(image_points):
        raise ValueError(
            f"got {len(object_points)} object points, {len(image_points)} image points"
        )
    n = len(object_points)
    K = _checked_pinhole(K)
    # Any number may come in and squares may overflow: what comes of it is looked at instead.
    with np.errstate(all="ignore"):
        rays = (image_points - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
        if covariance_px is None:
            sigma = np.broadcast_to(np.asarray(sigma_px, np.float64), n)
            whitening = np.eye(2) / np.where(sigma > 0, sigma, np.nan)[:, None, None]
        else:
            whitening = _inverse_root(np.asarray(covariance_px, np.float64).reshape(n, 2, 2))
        usable = np.isfinite(object_points).all(1) & (np.abs(rays) < MAX_TANGENT).all(1)
        usable &= np.isfinite(whitening).all((1, 2)) & (whitening[:, 0, 0] > 0)
        result = _solve(object_points[usable], rays[usable], K[:2, :2], whitening[usable])
    inliers = np.zeros(n, bool)
    inliers[usable] = result.inliers
    return replace(result, inliers=inliers)


def _inverse_root(covariance: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, "n 2 2"]:
    """Return W with WᵀW = Σ⁻¹ (W = L⁻¹ of Cholesky's Σ = LLᵀ); NaN where Σ is no covariance."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    first = np.sqrt(a)
    second = np.sqrt(c - (b / first) ** 2)
    roots = np.zeros(covariance.shape)
    roots[:, 0, 0] = 1 / first
    roots[:, 1, 0] = -b / (a * second)
    roots[:, 1, 1] = 1 / second
    return roots


def _checked_pinhole(K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    K = np.asarray(K, np.float64)
    proper = K.shape == (3, 3) and bool(np.isfinite(K).all()) and bool((K[2] == (0, 0, 1)).all())
    if not proper or np.linalg.det(K) == 0:
        raise ValueError(f"K must be a finite, invertible pinhole matrix, got {K.tolist()}")
    return K


def _solve(
    object_points: Float[np.ndarray, "n 3"],
    rays: Float[np.ndarray, "n 2"],
    to_px: Float[np.ndarray, "2 2"],
    whitening: Float[np.ndarray, "n 2 2"],
) -> PnPResult:
    """Solve for points that are all there; rays are their (x/z, y/z)."""
    nothing = PnPResult(None, np.inf, np.zeros(len(rays), bool))
    # The mean deviation over both directions: (det W)^(−1/2).
    sigma = (whitening[:, 0, 0] * whitening[:, 1, 1]) ** -0.5
    reason = _degenerate(object_points, rays @ to_px.T, sigma)
    if reason:
        return replace(nothing, reason=reason)
    centre, size = object_points.mean(0), float(np.linalg.norm(np.ptp(object_points, axis=0)))
    points = Correspondences((object_points - centre) / size, rays, whitening @ to_px)
    poses = _best_first(points)
    if not len(poses):
        return replace(nothing, reason="no start led to a pose in front of the camera")
    agree = np.linalg.norm(points.residuals(poses[:1])[0], axis=-1) <= GATE
    if agree.sum() < MIN_POINTS:
        reason = f"only {int(agree.sum())} points agree on one pose, {MIN_POINTS} are needed"
        return replace(nothing, reason=reason)
    # The gate has done its work: among points that agree, least squares is the better estimate.
    best = refine(points[agree], poses[:1], NO_GATE)
    rotation, translation = best.rotations[0], best.translations[0]
    T = make_transform(rotation, size * translation - rotation @ centre)
    off = np.linalg.solve(whitening[agree], points[agree].residuals(best)[0, :, :, None])
    error = float(np.sqrt(np.mean((off**2).sum((1, 2)))))
    return PnPResult(
        T, error, agree, covariance=_covariance(points[agree], best, size, rotation @ centre)
    )


def _covariance(
    points: Correspondences, pose: Poses, size: float, centre: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "6 6"]:
    """Invert the information and carry it from the points' centre to the object's origin.

    A turn ω about the centre is the same turn about the origin and a shift by centre × ω.

    Args:
        points: The inliers.
        pose: Their pose, translation in sizes.
        size: Metres per unit of the points.
        centre: Origin to centre in camera axes, metres.
    """
    carry = np.zeros((6, 6))
    carry[:3, :3], carry[3:, 3:] = np.eye(3), size * np.eye(3)
    carry[3:, :3] = np.cross(np.eye(3), centre)
    # Four points that agree but lie on a line leave a direction open: its variance is huge.
    return np.asarray(carry @ np.linalg.pinv(points.information(pose), rcond=1e-15) @ carry.T)


def _degenerate(
    object_points: Float[np.ndarray, "n 3"],
    image_points: Float[np.ndarray, "n 2"],
    sigma: Float[np.ndarray, "n"],
) -> str:
    """Say why these points cannot fix a pose, or return an empty string."""
    if len(object_points) < MIN_POINTS:
        return f"only {len(object_points)} usable points, {MIN_POINTS} are needed"
    extent = float(np.ptp(object_points, axis=0).max())
    if not SMALLEST < extent < LARGEST:
        return f"the object points extend over {extent:.3g} m"
    spread = np.linalg.svd((object_points - object_points.mean(0)) / extent, compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        return "the object points lie on one line"
    distinct = len({(x, y) for x, y in np.round(image_points, 3).tolist()})
    if distinct < MIN_POINTS:
        return f"only {distinct} distinct pixels, {MIN_POINTS} are needed"
    spread = np.linalg.svd(image_points - image_points.mean(0), compute_uv=False)
    if spread[1] < 1e-3 * spread[0]:
        return "the pixels lie on one line"
    if np.hypot(*spread) < np.median(sigma) * np.sqrt(len(image_points)):
        return "the pixels spread no wider than their own noise"
    return ""


def _best_first(points: Correspondences) -> Poses:
    """Return the plausible refined poses, the smallest truncated cost first.

    All points are tried together, then all but one, then all but two, until as many agree.
    """
    count = len(points.rays)
    normal = _thin_axis(points.object_points)
    poses = Poses(np.empty((0, 3, 3)), np.empty((0, 3)))
    for left_out in range(min(MOST_LEFT_OUT, count - MIN_POINTS) + 1):
        starts = _sqpnp(points, list(combinations(range(count), left_out)))
        starts = starts[_truncated_cost(points, starts).argsort()[:NUM_STARTS]]
        if normal is not None:
            starts += _mirrored(starts, normal)
        poses += refine(points, starts)
        poses = poses[_plausible(points, poses)]
        poses = poses[_truncated_cost(points, poses).argsort()]
        distance = np.linalg.norm(points.residuals(poses[:1]), axis=-1)
        if (distance <= GATE).sum() >= count - left_out:
            break
    return poses


def _truncated_cost(points: Correspondences, poses: Poses) -> Float[np.ndarray, "s"]:
    """Return the MSAC cost that poses are compared by: an outlier costs the gate."""
    squared = (points.residuals(poses) ** 2).sum(-1)
    return np.asarray(np.fmin(squared, GATE**2).sum(-1))


def _plausible(points: Correspondences, poses: Poses) -> Bool[np.ndarray, "s"]:
    """Tell sound poses: rotations, all points in front of the camera, at a believable distance."""
    depth = points.object_points @ poses.rotations[:, 2, :, None] + poses.translations[:, None, 2:]
    near = np.linalg.norm(poses.translations, axis=-1) <= MAX_DISTANCE
    proper = [is_rotation(rotation, tolerance=1e-6) for rotation in poses.rotations]
    return np.asarray((depth > 0).all((1, 2)) & near & np.array(proper, bool))


def _sqpnp(points: Correspondences, left_out: Sequence[tuple[int, ...]]) -> Poses:
    """Solve all points but some with OpenCV's SQPnP; NaN where it raises or finds no pose."""
    solved = np.full((len(left_out), 2, 3), np.nan)
    for pose, missing in zip(solved, left_out, strict=True):
        kept = [k for k in range(len(points.rays)) if k not in missing]
        with suppress(cv2.error):  # OpenCV 5 raises on coincident points
            found, *vectors = cv2.solvePnP(
                points.object_points[kept],
                points.rays[kept],
                _NO_CAMERA,
                None,
                flags=cv2.SOLVEPNP_SQPNP,
            )
            if found:
                pose[:] = np.hstack(vectors).T
    return Poses(rotation_vector_to_matrix(solved[:, 0]), solved[:, 1])


def _thin_axis(object_points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"] | None:
    """Return the unit normal of a plate; None for a thicker part, which has no second tilt."""
    _, extents, axes = np.linalg.svd(object_points - object_points.mean(0))
    return np.asarray(axes[2]) if extents[2] < PLATE * extents[0] else None


def _mirrored(poses: Poses, normal: Float[np.ndarray, "3"]) -> Poses:
    """Return the other tilt under which a plate looks almost the same.

    Seen from far away, a plate tilted by +θ and by −θ about the same axis have the same image. The
    second is the first reflected in the plane across the viewing ray r and, since a reflection is
    no rotation, also in the plate's own plane with normal n: R' = (I − 2rrᵀ) R (I − 2nnᵀ).
    """
    rays = poses.translations / np.linalg.norm(poses.translations, axis=-1, keepdims=True)
    across = np.eye(3) - 2 * rays[:, :, None] * rays[:, None, :]
    return Poses(
        across @ poses.rotations @ (np.eye(3) - 2 * np.outer(normal, normal)), poses.translations
    )
