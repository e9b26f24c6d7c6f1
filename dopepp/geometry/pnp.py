"""Perspective-n-point: nine or fewer keypoints and K in, one trustworthy pose or a reason out.

OpenCV supplies the closed-form start (SQPnP); our own part is what it lacks: per-point
covariances, robust weights, the pose's own covariance, the mirrored start that thin plates need,
and checks that no returned pose is NaN, behind the camera or at a wild distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.geometry.degeneracy import MIN_POINTS, degenerate
from dopepp.geometry.refine import (
    GATE,
    NO_GATE,
    Correspondences,
    Poses,
    normal_equations,
    refine,
    refine_pose,
    reproject,
)
from dopepp.geometry.rotation import Vector

MOST_LEFT_OUT: Final = 2
"""Outliers looked for by leaving points out; the robust cost bears more where these are mild."""

NUM_STARTS: Final = 3
"""How many of the poses from subsets are worth refining."""

MAX_DISTANCE: Final = 500.0
"""Farthest believable pose in object sizes: with a focal length of 1,000 px that is 2 px wide."""

MAX_TANGENT: Final = 1000.0
"""Distance from the principal point in focal lengths: 89.9° off the axis, where no pixel is."""

ROTATION_TOLERANCE: Final = 1e-6
"""Error of a rotation matrix's entries that refinement may leave."""

PLATE: Final = 0.3
"""Thickness over length up to which a part's mirrored tilt is tried as a start of its own."""

_NO_CAMERA: Final = np.eye(3)
_UNIT: Final = np.eye(2)


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

    T_cam_obj: Transform | None
    reprojection_error_px: float
    inliers: Bool[np.ndarray, "n"]
    reason: str = ""
    covariance: Float[np.ndarray, "6 6"] | None = None


def solve_pnp(
    object_points: Float[np.ndarray, "n 3"],
    image_points: Float[np.ndarray, "n 2"],
    K: CameraMatrix,
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

    Returned is the pose with the smallest robust cost among the refined starts: SQPnP on all
    points, its mirror image for a plate and, where outliers show, SQPnP on all but one and all but
    two. A ``ValueError``: the arguments differ in length, or K is no invertible pinhole matrix.
    """
    object_points = np.asarray(object_points, np.float64).reshape(-1, 3)
    image_points = np.asarray(image_points, np.float64).reshape(-1, 2)
    if len(object_points) != len(image_points):
        raise ValueError(
            f"got {len(object_points)} object points, {len(image_points)} image points"
        )
    K = _checked_pinhole(K)
    n = len(object_points)
    if covariance_px is None:
        sigma = np.broadcast_to(np.asarray(sigma_px, np.float64), n)
        # NaN for what is no deviation; an infinite one has no finite square.
        with np.errstate(all="ignore"):
            covariance_px = np.where(sigma > 0, sigma, np.nan)[:, None, None] ** 2 * _UNIT
    covariance_px = np.asarray(covariance_px, np.float64).reshape(n, 2, 2)
    rays, whitening, usable = _prepared(object_points, image_points, K, covariance_px)
    result = _solve(object_points[usable], rays[usable], K[:2, :2], whitening[usable])
    inliers = np.zeros(n, bool)
    inliers[usable] = result.inliers
    return replace(result, inliers=inliers)


@compiled()
def _prepared(
    object_points: Array, image_points: Array, K: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """Return rays, whitenings and which points can be used.

    A whitening is W with WᵀW = Σ⁻¹: the inverse of Cholesky's L with Σ = LLᵀ. Any number may come
    in and squares may overflow: what comes of it is looked at instead.
    """
    n = len(object_points)
    rays, whitening, usable = np.empty((n, 2)), np.zeros((n, 2, 2)), np.empty(n, np.bool_)
    determinant = K[0, 0] * K[1, 1] - K[0, 1] * K[1, 0]
    for i in range(n):
        u, v = image_points[i, 0] - K[0, 2], image_points[i, 1] - K[1, 2]
        rays[i, 0] = (K[1, 1] * u - K[0, 1] * v) / determinant
        rays[i, 1] = (K[0, 0] * v - K[1, 0] * u) / determinant
        a, b, c = covariance[i, 0, 0], covariance[i, 0, 1], covariance[i, 1, 1]
        first = math.sqrt(a) if a > 0.0 else math.nan
        rest = c - (b / first) ** 2
        second = math.sqrt(rest) if rest > 0.0 else math.nan
        whitening[i, 0, 0] = 1.0 / first
        whitening[i, 1, 0] = -b / (a * second)
        whitening[i, 1, 1] = 1.0 / second
        usable[i] = (
            np.isfinite(object_points[i]).all()
            and np.abs(rays[i]).max() < MAX_TANGENT
            and np.isfinite(whitening[i]).all()
            and whitening[i, 0, 0] > 0.0
            and whitening[i, 1, 1] > 0.0
        )
    return rays, whitening, usable


def _checked_pinhole(K: CameraMatrix) -> CameraMatrix:
    K = np.asarray(K, np.float64)
    proper = K.shape == (3, 3) and bool(np.isfinite(K).all()) and K[2].tolist() == [0, 0, 1]
    with np.errstate(over="ignore", invalid="ignore"):
        determinant = K[0, 0] * K[1, 1] - K[0, 1] * K[1, 0] if proper else 0.0
    if not (np.isfinite(determinant) and determinant != 0):
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
    reason = degenerate(object_points, rays @ to_px.T, sigma)
    if reason:
        return replace(nothing, reason=reason)
    centre = object_points.mean(0)
    size = math.hypot(*(object_points.max(0) - object_points.min(0)).tolist())
    points = Correspondences((object_points - centre) / size, rays, whitening @ to_px)
    poses = _best_first(points)
    if not len(poses):
        return replace(nothing, reason="no start led to a pose in front of the camera")
    agree = _agreeing(points, poses)
    if agree.sum() < MIN_POINTS:
        reason = f"only {int(agree.sum())} points agree on one pose, {MIN_POINTS} are needed"
        return replace(nothing, reason=reason)
    best = poses[:1]
    T, error, covariance = _concluded(
        points.object_points[agree], points.rays[agree], points.whitening[agree], to_px,
        best.rotations[0], best.translations[0], size, centre,
    )  # fmt: skip
    return PnPResult(T, error, agree, covariance=covariance)


@compiled()
def _concluded(
    object_points: Array,
    rays: Array,
    whitening: Array,
    to_px: Array,
    R: Array,
    t: Array,
    size: float,
    centre: Array,
) -> tuple[Array, float, Array]:
    """Return pose (metres), RMS error (pixels) and covariance from the points that agree.

    The gate has done its work: among points that agree, least squares is the better estimate. A
    turn ω about the points' centre is the same turn about the object's origin and a shift by
    centre × ω.
    """
    refine_pose(object_points, rays, whitening, R, t, NO_GATE)
    residuals = np.empty((len(rays), 2))
    reproject(object_points, rays, whitening, R, t, residuals)
    information, gradient = np.empty((6, 6)), np.empty(6)
    normal_equations(
        object_points, rays, whitening, R, t, residuals, NO_GATE, information, gradient
    )
    moved = np.zeros(3)
    for k in range(3):
        moved[k] = R[k, 0] * centre[0] + R[k, 1] * centre[1] + R[k, 2] * centre[2]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, size * t - moved
    pixels = np.empty(whitening.shape)
    pixels[:] = to_px
    reproject(object_points, rays, pixels, R, t, residuals)
    error = math.sqrt((residuals**2).sum() / len(rays))
    carry = np.zeros((6, 6))
    for k in range(3):
        carry[k, k], carry[3 + k, 3 + k] = 1.0, size
    carry[3, 1], carry[3, 2] = -moved[2], moved[1]
    carry[4, 0], carry[4, 2] = moved[2], -moved[0]
    carry[5, 0], carry[5, 1] = -moved[1], moved[0]
    # Four points that agree but lie on a line leave a direction open: its variance is huge.
    covariance = carry @ np.linalg.pinv(information, 1e-15) @ carry.T
    return T, error, covariance


def _best_first(points: Correspondences) -> Poses:
    """Return the plausible refined poses, the smallest truncated cost first.

    All points are tried together, then all but one, then all but two, until as many agree.
    """
    count = len(points.rays)
    extents, axes = _principal_axes(points.object_points)
    poses = Poses(np.empty((0, 3, 3)), np.empty((0, 3)))
    for left_out in range(min(MOST_LEFT_OUT, count - MIN_POINTS) + 1):
        starts = _sqpnp(points, list(combinations(range(count), left_out)))
        if len(starts) > NUM_STARTS:
            starts = starts[_truncated_cost(points, starts).argsort()[:NUM_STARTS]]
        if extents[2] < PLATE * extents[0]:  # a thicker part has no second tilt
            starts += _mirrored(starts, axes[2])
        refined = refine(points, starts)
        poses += refined[_plausible(points, refined)]
        if len(poses) > 1:
            poses = poses[_truncated_cost(points, poses).argsort()]
        if len(poses) and _agreeing(points, poses).sum() >= count - left_out:
            break
    return poses


def _agreeing(points: Correspondences, poses: Poses) -> Bool[np.ndarray, "n"]:
    """Tell which points lie within the gate of the first pose."""
    squared = points.residuals(poses[:1])[0] ** 2
    return np.asarray(squared[:, 0] + squared[:, 1] <= GATE**2)


def _truncated_cost(points: Correspondences, poses: Poses) -> Float[np.ndarray, "s"]:
    """Return the MSAC cost that poses are compared by: an outlier costs the gate."""
    squared = (points.residuals(poses) ** 2).sum(-1)
    return np.asarray(np.fmin(squared, GATE**2).sum(-1))


def _plausible(points: Correspondences, poses: Poses) -> Bool[np.ndarray, "s"]:
    """Tell sound poses: rotations, all points in front of the camera, at a believable distance."""
    pairs = zip(poses.rotations, poses.translations, strict=True)
    return np.array([_is_plausible(points.object_points, R, t) for R, t in pairs], bool)


@compiled()
def _is_plausible(object_points: Array, R: Array, t: Array) -> bool:
    for i in range(len(object_points)):
        x, y, z = object_points[i, 0], object_points[i, 1], object_points[i, 2]
        if not R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2] > 0.0:
            return False
    if not math.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2) <= MAX_DISTANCE:
        return False
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for k in range(3):
            # A right-handed frame: each row is the cross product of the next two.
            m, n = (k + 1) % 3, (k + 2) % 3
            if not abs(R[b, m] * R[c, n] - R[b, n] * R[c, m] - R[a, k]) <= ROTATION_TOLERANCE:
                return False
    return True


def _sqpnp(points: Correspondences, left_out: Sequence[tuple[int, ...]]) -> Poses:
    """Solve all points but some with OpenCV's SQPnP; NaN where it raises or finds no pose."""
    rotations = np.full((len(left_out), 3, 3), np.nan)
    translations = np.full((len(left_out), 3), np.nan)
    for R, t, missing in zip(rotations, translations, left_out, strict=True):
        kept = [k for k in range(len(points.rays)) if k not in missing]
        with suppress(cv2.error):  # OpenCV 5 raises on coincident points
            found, turn, move = cv2.solvePnP(
                points.object_points[kept],
                points.rays[kept],
                _NO_CAMERA,
                None,
                flags=cv2.SOLVEPNP_SQPNP,
            )
            if found:
                R[:], t[:] = cv2.Rodrigues(turn)[0], move[:, 0]
    return Poses(rotations, translations)


@compiled()
def _principal_axes(points: Array) -> tuple[Array, Array]:
    """Return the singular values of centred points and their axes, longest first."""
    n = len(points)
    # At least three rows give three axes.
    centred = np.zeros((n, 3))
    for axis in range(3):
        centred[:, axis] = points[:, axis] - points[:, axis].mean()
    _, extents, axes = np.linalg.svd(centred, False)
    return extents, axes


def _mirrored(poses: Poses, normal: Vector) -> Poses:
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
