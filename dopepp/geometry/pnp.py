"""Perspective-n-point: nine or fewer keypoints and K in, one trustworthy pose or a reason out.

OpenCV supplies the closed-form start (SQPnP); our own part is what it lacks: per-point
covariances, robust weights, the pose's own covariance, the mirrored start that thin plates need,
and checks that no returned pose is NaN, behind the camera or at a wild distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Final, TypeAlias

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
    Correspondences,
    column_mean,
    copy_pose,
    degenerate,
    normal_equations,
    refine_pose,
    reproject,
    turn,
)
from dopepp.geometry.rotation import RotationMatrix, Vector

MOST_LEFT_OUT: Final = 2
"""Outliers looked for by leaving points out; the robust cost bears more where these are mild."""

NUM_STARTS: Final = 3  # How many of the poses from subsets are worth refining
MAX_DISTANCE: Final = 500.0
"""Farthest believable pose in object sizes: with a focal length of 1,000 px that is 2 px wide."""

MAX_TANGENT: Final = 1000.0
"""Distance from the principal point in focal lengths: 89.9° off the axis, where no pixel is."""

ROTATION_TOLERANCE: Final = 1e-6  # Error of a rotation matrix's entries that refinement may leave
PLATE: Final = 0.3
"""Thickness over length up to which a part's mirrored tilt is tried as a start of its own."""

_NO_CAMERA: Final = np.eye(3)
_UNIT: Final = np.eye(2)


Solved: TypeAlias = tuple[
    Transform | None, float, Bool[np.ndarray, "n"], str, Float[np.ndarray, "6 6"] | None
]
"""The attributes of a :class:`PnPResult`, of the points that can be used."""


@dataclass(frozen=True)
class PnPResult:
    """A pose, or the reason for having none.

    Attributes:
        T_cam_obj: Object-to-camera transform in metres; None when there is no trustworthy pose.
        reprojection_error_px: RMS distance over the inliers, pixels; infinite without a pose.
        inliers: The given points that agree with the pose within
            :data:`~dopepp.geometry.refine.GATE` standard deviations.
        reason: Why there is no pose; empty when there is one.
        covariance: Of a small turn about the object's origin and a small shift (camera axes,
            radians, metres), from the inliers' covariances; None without a pose.
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
    widenings: Sequence[float] = (1.0,),
) -> PnPResult:
    """Estimate a pose from point correspondences, tolerating missing and wild points.

    Args:
        object_points: Points in the object frame, metres.
        image_points: Their pixels; a row with NaN is a missing point.
        K: Camera matrix, pixels; it may have skew.
        sigma_px: Standard deviation of each pixel position (isotropic), pixels.
        covariance_px: Covariance of each pixel position, pixels², in place of ``sigma_px``. A point
            whose deviation or covariance is not finite and positive (definite) is missing.
        widenings: Ascending factors on the standard deviations, tried in turn until two thirds of
            the points agree on a pose; the pose with the most agreeing points wins.

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
    K, n = np.ascontiguousarray(K, np.float64), len(object_points)
    if not (K.shape == (3, 3) and _is_pinhole(K)):
        raise ValueError(f"K must be a finite, invertible pinhole matrix, got {K.tolist()}")
    if covariance_px is None:
        sigma = np.broadcast_to(np.asarray(sigma_px, np.float64), n)
        # NaN for what is no deviation; an infinite one has no finite square.
        with np.errstate(all="ignore"):
            covariance_px = np.where(sigma > 0, sigma, np.nan)[:, None, None] ** 2 * _UNIT
    covariance_px = np.asarray(covariance_px, np.float64).reshape(n, 2, 2)
    rays, whitening, usable = _prepared(object_points, image_points, K, covariance_px)
    T, error, agree, reason, covariance = _solve(
        object_points[usable], rays, K[:2, :2].copy(), whitening, widenings
    )
    inliers = np.zeros(n, bool)
    inliers[usable] = agree
    return PnPResult(T, error, inliers, reason, covariance)


@compiled()
def _prepared(
    object_points: Array, image_points: Array, K: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """Return the usable points' rays and whitenings W (WᵀW = Σ⁻¹), and which points these are."""
    # Any number may come in and squares may overflow: the results are checked instead. W is the
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
def _is_pinhole(K: Array) -> bool:
    """Tell a finite, invertible pinhole matrix."""
    determinant = K[0, 0] * K[1, 1] - K[0, 1] * K[1, 0]
    last = K[2, 0] == 0.0 and K[2, 1] == 0.0 and K[2, 2] == 1.0
    finite = np.isfinite(K).all() and math.isfinite(determinant)
    return bool(last and finite and determinant != 0.0)


def _solve(
    object_points: Float[np.ndarray, "n 3"],
    rays: Float[np.ndarray, "n 2"],
    to_px: Float[np.ndarray, "2 2"],
    whitening: Float[np.ndarray, "n 2 2"],
    widenings: Sequence[float],
) -> Solved:
    """Solve for points that are all there; rays are their (x/z, y/z)."""
    nobody = np.zeros(len(rays), bool)
    reason = degenerate(object_points, rays, to_px, whitening)
    if reason:
        return None, math.inf, nobody, reason, None
    centre = object_points.mean(0)
    size = math.hypot(*(object_points.max(0) - object_points.min(0)).tolist())
    centred = (object_points - centre) / size
    starts = _Starts(centred, rays)
    best: Solved | None = None
    for widening in widenings:
        points = Correspondences(centred, rays, whitening @ to_px / widening)
        pose, agree = _best_pose(points, starts)
        solved: Solved
        if pose is None:
            solved = (None, math.inf, nobody, "no start led to a pose in front of the camera", None)
        elif agree.sum() < MIN_POINTS:
            few = f"only {int(agree.sum())} points agree on one pose, {MIN_POINTS} are needed"
            solved = (None, math.inf, nobody, few, None)
        else:
            T, error, covariance = _concluded(
                centred[agree], rays[agree], points.whitening[agree], to_px, *pose, size, centre
            )
            solved = (T, error, agree, "", covariance)
        if best is None or solved[2].sum() > best[2].sum():
            best = solved
        if 3 * best[2].sum() >= 2 * len(rays):
            break
    assert best is not None
    return best


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
    """Return pose (metres), RMS error (pixels) and covariance from the points that agree."""
    # Among points that agree, least squares is the better estimate. A turn ω about the points'
    # centre is the same turn about the object's origin and a shift by centre × ω.
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
    for k in range(3):
        T[k, 3] = size * t[k] - moved[k]
        for m in range(3):
            T[k, m] = R[k, m]
    pixels = np.empty(whitening.shape)
    for i in range(len(pixels)):
        for k in range(2):
            for m in range(2):
                pixels[i, k, m] = to_px[k, m]
    reproject(object_points, rays, pixels, R, t, residuals)
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
    # Four points that agree but lie on a line leave a direction open: its variance is huge.
    covariance = carry @ np.linalg.pinv(information, 1e-15) @ carry.T
    return T, error, covariance


class _Starts:
    """Closed-form poses of all points, all but one and all but two, for every widening."""

    def __init__(
        self, object_points: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 2"]
    ) -> None:
        self.object_points, self.rays = object_points, rays
        extents, axes = _principal_axes(object_points)
        self.normal, self.is_plate = axes[2], bool(extents[2] < PLATE * extents[0])
        self._steps: list[Float[np.ndarray, "s 6"]] = []

    def without(self, left_out: int) -> Float[np.ndarray, "s 6"]:
        """Return SQPnP's poses (rotation vector, translation) of all points but so many, or NaN."""
        while len(self._steps) <= left_out:
            kept = _kept(len(self.rays), len(self._steps))
            steps = np.full((len(kept), 6), np.nan)
            for step, rows in zip(steps, kept, strict=True):
                with suppress(cv2.error):  # OpenCV 5 raises on coincident points
                    solved, vector, move = cv2.solvePnP(
                        self.object_points[rows],
                        self.rays[rows],
                        _NO_CAMERA,
                        None,
                        flags=cv2.SOLVEPNP_SQPNP,
                    )
                    if solved:
                        step[:3], step[3:] = vector[:, 0], move[:, 0]
            self._steps.append(steps)
        return self._steps[left_out]


@cache
def _kept(count: int, left_out: int) -> list[NDArray[np.intp]]:
    """Return the rows that stay where so many of them are left out, all ways."""
    return [np.array(rows) for rows in combinations(range(count), count - left_out)][::-1]


def _best_pose(
    points: Correspondences, starts: _Starts
) -> tuple[tuple[RotationMatrix, Vector] | None, Bool[np.ndarray, "n"]]:
    """Return the refined pose with the smallest truncated cost, and which points agree with it."""
    R, t, cost = np.empty((3, 3)), np.empty(3), math.inf
    count = len(points.rays)
    agree = np.zeros(count, bool)
    for left_out in range(min(MOST_LEFT_OUT, count - MIN_POINTS) + 1):
        cost = _improved(
            points.object_points, points.rays, points.whitening, starts.without(left_out),
            starts.normal, starts.is_plate, R, t, cost, agree,
        )  # fmt: skip
        if cost < math.inf and agree.sum() >= count - left_out:
            break
    return (None if cost == math.inf else (R, t)), agree


@compiled()
def _improved(
    object_points: Array,
    rays: Array,
    whitening: Array,
    starts: Array,
    normal: Array,
    is_plate: bool,
    best_R: Array,
    best_t: Array,
    best: float,
    agree: Array,
) -> float:
    """Refine the likeliest starts, update the best pose and ``agree``, and return its cost.

    Besides each start of a plate, its other tilt is refined; a thicker part has none.
    """
    count = len(starts)
    residuals = np.empty((len(rays), 2))
    rotations, costs = np.empty((count, 3, 3)), np.empty(count)
    for s in range(count):
        turn(starts[s], np.eye(3), rotations[s])
        reproject(object_points, rays, whitening, rotations[s], starts[s, 3:], residuals)
        costs[s] = _truncated_cost(residuals)
    R, t = np.empty((3, 3)), np.empty(3)
    for s in costs.argsort()[:NUM_STARTS]:
        for tilt in range(2 if is_plate else 1):
            copy_pose(rotations[s], starts[s, 3:], R, t)
            if tilt:
                _mirror(R, t, normal)
            refine_pose(object_points, rays, whitening, R, t, GATE)
            if not _is_plausible(object_points, R, t):
                continue
            reproject(object_points, rays, whitening, R, t, residuals)
            cost = _truncated_cost(residuals)
            if cost < best:
                best = cost
                copy_pose(R, t, best_R, best_t)
                for i in range(len(rays)):
                    agree[i] = residuals[i, 0] ** 2 + residuals[i, 1] ** 2 <= GATE**2
    return best


@compiled()
def _truncated_cost(residuals: Array) -> float:
    """Return the MSAC cost that poses are compared by: an outlier costs the gate."""
    cost = 0.0
    for i in range(len(residuals)):
        squared = residuals[i, 0] ** 2 + residuals[i, 1] ** 2
        cost += squared if squared < GATE**2 else GATE**2
    return cost


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
def _mirror(R: Array, t: Array, normal: Array) -> None:
    """Turn a pose into the other tilt under which a plate looks almost the same.

    Seen from far away, a plate tilted by +θ and by −θ about the same axis have the same image. The
    second is the first reflected in the plane across the viewing ray r and, since a reflection is
    no rotation, also in the plate's own plane with normal n: R' = (I − 2rrᵀ) R (I − 2nnᵀ).
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
