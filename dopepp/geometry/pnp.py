"""Perspective-n-point: estimate a pose from up to nine keypoints and K, or explain the failure.

OpenCV supplies the closed-form start (SQPnP). This module adds covariances of the points, robust
weights, the covariance of the pose and a mirrored start for thin plates. No returned pose is NaN,
behind the camera or implausibly far away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.geometry.refine import (
    GATE,
    MIN_POINTS,
    NO_GATE,
    ObjectPoints,
    Points,
    Rays,
    Whitenings,
    apply_rotation,
    column_mean,
    copy_pose,
    degenerate,
    normal_equations,
    refine_pose,
    reproject,
)
from dopepp.geometry.rotation import RotationMatrix, Vector

MAX_LEFT_OUT: Final = 2
"""Largest number of points left out of a start; the robust cost tolerates further mild outliers."""

NUM_STARTS: Final = 3  # Starts from subsets that are refined
MAX_DISTANCE: Final = 500.0
"""Farthest plausible pose in object sizes: 2 px wide at a focal length of 1,000 px."""

MAX_TANGENT: Final = 1000.0
"""Largest distance from the principal point in focal lengths: 89.9° off the axis."""

ROTATION_TOLERANCE: Final = 1e-6  # Largest error of a refined rotation matrix's entries
PLATE: Final = 0.3  # Largest thickness over length of a part whose mirrored tilt is refined as well
_ONE_PIXEL: Final = np.eye(2)


@dataclass(frozen=True)
class PnPResult:
    """An estimated pose, or the reason for its absence."""

    T_cam_obj: Transform | None  # object to camera, metres; None without a plausible pose
    reprojection_error_px: float  # RMS distance over the inliers; infinite without a pose
    inliers: Bool[np.ndarray, "n"]  # whether each point is within GATE deviations of its projection
    reason: str = ""  # reason for the missing pose; empty with a pose
    # Covariance of a rotation vector about the object's origin and a shift (camera axes, radians,
    # metres), from the inliers' covariances; None without a pose
    covariance: Float[np.ndarray, "6 6"] | None = None


def solve_pnp(
    object_points: Float[np.ndarray, "n 3"],
    image_points: Float[np.ndarray, "n 2"],
    K: CameraMatrix,
    covariance_px: Float[np.ndarray, "*#n 2 2"] = _ONE_PIXEL,
    widenings: Sequence[float] = (1.0,),
) -> PnPResult:
    """Estimate a pose from point correspondences with missing points and outliers.

    Args:
        object_points: Points in the object frame, metres.
        image_points: Positions of the points on the image, pixels; NaN marks a missing point.
        K: Camera matrix, pixels; it may have skew.
        covariance_px: Covariance of each point's position, or one for all points, pixels² (default:
            one pixel of standard deviation). A point is missing if its covariance is not finite and
            positive definite.
        widenings: Ascending factors on the standard deviations, tried in turn until two thirds of
            the points agree on a pose. The pose with the most agreeing points is returned.

    Returns:
        The pose with the smallest robust cost among the refined starts: SQPnP on all points, its
        mirror image for a plate and, with outliers, SQPnP on subsets without one or two points.

    Raises:
        ValueError: The arguments differ in length, or K is not an invertible pinhole matrix.
    """
    # Copies of one memory layout: another one would compile :func:`_prepare` again.
    object_points = np.array(object_points, np.float64, order="C").reshape(-1, 3)
    image_points = np.array(image_points, np.float64, order="C").reshape(-1, 2)
    if len(object_points) != len(image_points):
        raise ValueError(
            f"got {len(object_points)} object points, {len(image_points)} image points"
        )
    K, n = np.ascontiguousarray(K, np.float64), len(object_points)
    if not (K.shape == (3, 3) and _is_pinhole(K)):
        raise ValueError(f"K must be a finite, invertible pinhole matrix, got {K.tolist()}")
    covariances = np.broadcast_to(covariance_px, (n, 2, 2)).astype(np.float64, order="C")
    rays, whitening, usable = _prepare(object_points, image_points, K, covariances)
    points = Points(object_points[usable], rays, whitening)
    result = _solve(points, K[:2, :2].copy(), widenings)
    inliers = np.zeros(n, bool)
    inliers[usable] = result.inliers
    return replace(result, inliers=inliers)


@compiled()
def _prepare(
    object_points: ObjectPoints,
    image_points: Float[np.ndarray, "n 2"],
    K: CameraMatrix,
    covariance: Float[np.ndarray, "n 2 2"],
) -> tuple[Rays, Whitenings, Bool[np.ndarray, "n"]]:
    """Return rays and pixel whitenings of the usable points, and the mask of the usable points.

    A point is usable if it is finite, its ray is within ``MAX_TANGENT`` of the optical axis, and
    its covariance Σ is positive definite. A whitening W of Σ has WᵀW = Σ⁻¹.
    """
    # Inputs may be any number and squares may overflow, so the results are checked. W is the
    # inverse of Cholesky's L with Σ = LLᵀ.
    n, count = len(object_points), 0
    rays, whitening, usable = np.empty((n, 2)), np.zeros((n, 2, 2)), np.empty(n, np.bool_)
    determinant = K[0, 0] * K[1, 1] - K[0, 1] * K[1, 0]
    for i in range(n):
        u, v = image_points[i, 0] - K[0, 2], image_points[i, 1] - K[1, 2]
        x = (K[1, 1] * u - K[0, 1] * v) / determinant
        y = (K[0, 0] * v - K[1, 0] * u) / determinant
        a, b, c = covariance[i, 0, 0], covariance[i, 0, 1], covariance[i, 1, 1]
        first = math.sqrt(a) if a > 0.0 else math.nan
        rest = c - (b / first) ** 2
        second = math.sqrt(rest) if rest > 0.0 else math.nan
        across = -b / (a * second)
        usable[i] = (
            np.isfinite(object_points[i]).all()
            and abs(x) < MAX_TANGENT
            and abs(y) < MAX_TANGENT
            and math.isfinite(across)
            and 0.0 < 1.0 / first < math.inf
            and 0.0 < 1.0 / second < math.inf
        )
        if usable[i]:
            rays[count, 0], rays[count, 1] = x, y
            whitening[count, 0, 0], whitening[count, 1, 0] = 1.0 / first, across
            whitening[count, 1, 1] = 1.0 / second
            count += 1
    return rays[:count], whitening[:count], usable


@compiled()
def _is_pinhole(K: CameraMatrix) -> bool:
    """Return whether K is a finite, invertible pinhole matrix."""
    determinant = K[0, 0] * K[1, 1] - K[0, 1] * K[1, 0]
    last = K[2, 0] == 0.0 and K[2, 1] == 0.0 and K[2, 2] == 1.0
    finite = np.isfinite(K).all() and math.isfinite(determinant)
    return bool(last and finite and determinant != 0.0)


def _solve(
    points: Points, to_px: Float[np.ndarray, "2 2"], widenings: Sequence[float]
) -> PnPResult:
    """Solve for usable points with whitenings of pixels; ``to_px`` maps rays to pixels."""
    object_points, rays, whitening = points
    no_inliers = np.zeros(len(rays), bool)
    if reason := degenerate(points, to_px):
        return PnPResult(None, math.inf, no_inliers, reason)
    centre = object_points.mean(0)
    size = math.hypot(*(object_points.max(0) - object_points.min(0)).tolist())
    centred = (object_points - centre) / size
    starts, results = _Starts(centred, rays), []
    for widening in widenings:
        ray_whitening = whitening @ to_px / widening
        pose, agree = _best_pose(ray_whitening, starts)
        if pose is None:
            reason = "no initial pose converged in front of the camera"
            result = PnPResult(None, math.inf, no_inliers, reason)
        elif agree.sum() < MIN_POINTS:
            reason = f"only {int(agree.sum())} points agree on a pose, {MIN_POINTS} are needed"
            result = PnPResult(None, math.inf, no_inliers, reason)
        else:
            agreeing = Points(centred[agree], rays[agree], ray_whitening[agree])
            T, error, covariance = _fit_inliers(agreeing, to_px, *pose, size, centre)
            result = PnPResult(T, error, agree, "", covariance)
        results.append(result)
        if 3 * result.inliers.sum() >= 2 * len(rays):
            break
    return max(results, key=lambda result: int(result.inliers.sum()))


@compiled()
def _fit_inliers(
    points: Points, to_px: Array, R: RotationMatrix, t: Vector, size: float, centre: Vector
) -> tuple[Transform, float, Float[np.ndarray, "6 6"]]:
    """Fit the pose (R, t) to its inliers by least squares, in place.

    The points are those of the object minus ``centre``, divided by ``size`` (metres).

    Returns:
        Pose of the object's frame (metres), RMS reprojection error (pixels) and covariance.
    """
    # Least squares is the best estimate for points that agree. A rotation ω about the points'
    # centre is the same rotation about the object's origin and a shift by centre × ω.
    rays = points.rays
    refine_pose(points, R, t, NO_GATE)
    residuals = np.empty((len(rays), 2))
    reproject(points, R, t, residuals)
    information, gradient = np.empty((6, 6)), np.empty(6)
    normal_equations(points, R, t, residuals, NO_GATE, information, gradient)
    moved = np.zeros(3)
    for k in range(3):
        moved[k] = R[k, 0] * centre[0] + R[k, 1] * centre[1] + R[k, 2] * centre[2]
    T = np.eye(4)
    for k in range(3):
        T[k, 3] = size * t[k] - moved[k]
        for m in range(3):
            T[k, m] = R[k, m]
    pixels = np.empty(points.whitening.shape)
    for i in range(len(pixels)):
        for k in range(2):
            for m in range(2):
                pixels[i, k, m] = to_px[k, m]
    reproject(Points(points.solid, rays, pixels), R, t, residuals)
    squared = 0.0
    for i in range(len(rays)):
        for k in range(2):
            squared += residuals[i, k] ** 2
    error = math.sqrt(squared / len(rays))
    carry = np.zeros((6, 6))
    for k in range(3):
        carry[k, k], carry[3 + k, 3 + k] = 1.0, size
    carry[3, 1], carry[3, 2] = -moved[2], moved[1]
    carry[4, 0], carry[4, 2] = moved[2], -moved[0]
    carry[5, 0], carry[5, 1] = -moved[1], moved[0]
    covariance = carry @ np.linalg.pinv(information, 1e-15) @ carry.T
    return T, error, covariance


class _Starts:
    """Closed-form poses from all points and from subsets without one or two points."""

    def __init__(self, object_points: ObjectPoints, rays: Rays) -> None:
        self.object_points, self.rays = object_points, rays
        extents, axes = _principal_axes(object_points)
        self.normal, self.is_plate = axes[2], bool(extents[2] < PLATE * extents[0])
        self._steps: list[Float[np.ndarray, "s 6"]] = []

    def without(self, left_out: int) -> Float[np.ndarray, "s 6"]:
        """Return SQPnP's pose (rotation vector, translation) per subset, NaN for failures."""
        while len(self._steps) <= left_out:
            kept = _selections(len(self.rays), len(self._steps))
            steps = np.full((len(kept), 6), np.nan)
            for step, rows in zip(steps, kept, strict=True):
                step[:] = sqpnp(self.object_points[rows], self.rays[rows], np.eye(3))
            self._steps.append(steps)
        return self._steps[left_out]


def sqpnp(
    object_points: Float[np.ndarray, "n 3"], image_points: Float[np.ndarray, "n 2"], K: CameraMatrix
) -> Float[np.ndarray, "6"]:
    """Return the closed-form pose (rotation vector, translation); NaN for a failure."""
    with suppress(cv2.error):  # OpenCV 5 raises on coincident points
        flags = cv2.SOLVEPNP_SQPNP
        solved, vector, move = cv2.solvePnP(object_points, image_points, K, None, flags=flags)
        if solved:
            return np.concatenate([vector[:, 0], move[:, 0]])
    return np.full(6, np.nan)


@cache
def _selections(count: int, left_out: int) -> list[NDArray[np.intp]]:
    """Return the row indices of every subset of ``count`` rows that omits ``left_out`` rows."""
    return [np.array(rows) for rows in combinations(range(count), count - left_out)][::-1]


def _best_pose(
    whitening: Whitenings, starts: _Starts
) -> tuple[tuple[RotationMatrix, Vector] | None, Bool[np.ndarray, "n"]]:
    """Return the refined pose with the smallest truncated cost, or None, and the inlier mask."""
    R, t, cost = np.empty((3, 3)), np.empty(3), math.inf
    points, count = Points(starts.object_points, starts.rays, whitening), len(whitening)
    normal, is_plate = starts.normal, starts.is_plate
    agree = np.zeros(count, bool)
    for left_out in range(min(MAX_LEFT_OUT, count - MIN_POINTS) + 1):
        poses = starts.without(left_out)
        cost = _improve(points, poses, normal, is_plate, R, t, cost, agree)
        if cost < math.inf and agree.sum() >= count - left_out:
            break
    return (None if cost == math.inf else (R, t)), agree


@compiled()
def _improve(
    points: Points,
    starts: Float[np.ndarray, "s 6"],
    normal: Vector,
    is_plate: bool,
    best_R: RotationMatrix,
    best_t: Vector,
    best: float,
    agree: Bool[np.ndarray, "n"],
) -> float:
    """Refine the starts of least truncated cost; update the best pose and its inliers ``agree``.

    Start poses are a rotation vector and a translation; ``NUM_STARTS`` of them are refined. For a
    plate with a ``normal``, the mirrored tilt of each start pose is refined as well.

    Returns:
        The truncated cost of the best pose.
    """
    count, rays = len(starts), points.rays
    residuals = np.empty((len(rays), 2))
    rotations, costs = np.empty((count, 3, 3)), np.empty(count)
    for s in range(count):
        apply_rotation(starts[s], np.eye(3), rotations[s])
        reproject(points, rotations[s], starts[s, 3:], residuals)
        costs[s] = _truncated_cost(residuals)
    R, t = np.empty((3, 3)), np.empty(3)
    for s in costs.argsort()[:NUM_STARTS]:
        for tilt in range(2 if is_plate else 1):
            copy_pose(rotations[s], starts[s, 3:], R, t)
            if tilt:
                _mirror(R, t, normal)
            refine_pose(points, R, t, GATE)
            if not _is_plausible(points.solid, R, t):
                continue
            reproject(points, R, t, residuals)
            cost = _truncated_cost(residuals)
            if cost < best:
                best = cost
                copy_pose(R, t, best_R, best_t)
                for i in range(len(rays)):
                    agree[i] = residuals[i, 0] ** 2 + residuals[i, 1] ** 2 <= GATE**2
    return best


@compiled()
def _truncated_cost(residuals: Array) -> float:
    """Return the MSAC cost of a pose, Σ min(r², GATE²) over the points' whitened errors r."""
    cost = 0.0
    for i in range(len(residuals)):
        squared = residuals[i, 0] ** 2 + residuals[i, 1] ** 2
        cost += squared if squared < GATE**2 else GATE**2
    return cost


@compiled()
def _is_plausible(object_points: ObjectPoints, R: RotationMatrix, t: Vector) -> bool:
    """Return whether R is a rotation, t at most MAX_DISTANCE long, and all depths are positive."""
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


@compiled()
def _principal_axes(points: Array) -> tuple[Array, Array]:
    """Return the singular values of centred points and their axes, longest first."""
    n = len(points)
    # At least three rows give three axes.
    centred = np.zeros((n, 3))
    for axis in range(3):
        mean = column_mean(points, axis)
        for i in range(n):
            centred[i, axis] = points[i, axis] - mean
    _, extents, axes = np.linalg.svd(centred, False)
    return extents, axes


@compiled()
def _mirror(R: RotationMatrix, t: Vector, normal: Vector) -> None:
    """Replace a plate's pose by the mirrored tilt, which has almost the same image.

    From afar, plates tilted by +θ and by −θ about an axis have the same image. The mirrored pose
    is reflected twice: in the plane perpendicular to the viewing ray r, and in the plate's plane
    with normal n. The product is a rotation: R' = (I − 2rrᵀ) R (I − 2nnᵀ).
    """
    squared = t[0] ** 2 + t[1] ** 2 + t[2] ** 2
    for column in range(3):
        along = 2 * (t[0] * R[0, column] + t[1] * R[1, column] + t[2] * R[2, column]) / squared
        for row in range(3):
            R[row, column] -= along * t[row]
    for row in range(3):
        along = 2 * (R[row, 0] * normal[0] + R[row, 1] * normal[1] + R[row, 2] * normal[2])
        for column in range(3):
            R[row, column] -= along * normal[column]
