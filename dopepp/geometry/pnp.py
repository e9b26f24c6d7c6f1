"""Perspective-n-point: nine or fewer keypoints and K in, one trustworthy pose or a reason out.

OpenCV supplies the closed-form start (SQPnP); our own part is what it lacks: per-point standard
deviations, robust weights, the mirrored start that thin plates need, and checks that no returned
pose is NaN, behind the camera or at a wild distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float

from dopepp.geometry.camera import make_transform
from dopepp.geometry.refine import GATE, Correspondences, refine
from dopepp.geometry.rotation import is_rotation, rotation_vector_to_matrix

MIN_POINTS: Final = 4

NUM_SUBSET_STARTS: Final = 3
"""How many of the poses from subsets are worth refining."""

MAX_DISTANCE: Final = 500.0
"""Farthest believable pose in object sizes: with a focal length of 1,000 px that is 2 px wide."""

MAX_TANGENT: Final = 1000.0
"""Distance from the principal point in focal lengths: 89.9° off the axis, where no pixel is."""

PLATE: Final = 0.3
"""Thickness over length up to which a part's mirrored tilt is tried as a start of its own."""

_NO_CAMERA: Final = np.eye(3)

Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]


@dataclass(frozen=True)
class PnPResult:
    """A pose, or the reason for having none.

    Attributes:
        T_cam_obj: Object-to-camera transform in metres; None when there is no trustworthy pose.
        reprojection_error_px: RMS distance over the inliers, pixels; infinite without a pose.
        inliers: Which of the given points agree with the pose within
            :data:`~dopepp.geometry.refine.GATE` standard deviations.
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
        K: Camera matrix, pixels; it may have skew.
        sigma_px: Standard deviation of each pixel position (isotropic), pixels; a point whose
            deviation is not finite and positive is missing.

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
    sigma = np.broadcast_to(np.asarray(sigma_px, np.float64), len(object_points))
    K = _checked_pinhole(K)
    # Any number may come in and squares may overflow: what comes of it is looked at instead.
    with np.errstate(all="ignore"):
        rays = (image_points - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
        usable = np.isfinite(object_points).all(1) & (np.abs(rays) < MAX_TANGENT).all(1)
        usable &= np.isfinite(sigma) & (sigma > 0)
        result = _solve(object_points[usable], rays[usable], K[:2, :2], sigma[usable])
    inliers = np.zeros(len(usable), bool)
    inliers[usable] = result.inliers
    return replace(result, inliers=inliers)


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
    sigma: Float[np.ndarray, "n"],
) -> PnPResult:
    """Solve for points that are all there; rays are their (x/z, y/z)."""
    nothing = PnPResult(None, np.inf, np.zeros(len(rays), bool))
    reason = _degenerate(object_points, rays @ to_px.T, sigma)
    if reason:
        return replace(nothing, reason=reason)
    centre, size = object_points.mean(0), float(np.linalg.norm(np.ptp(object_points, axis=0)))
    points = Correspondences((object_points - centre) / size, rays, to_px, sigma)
    best = _best_pose(points)
    if best is None:
        return replace(nothing, reason="no start led to a pose in front of the camera")
    rotation, translation = best
    residuals = np.linalg.norm(points.residuals(rotation[None], translation[None])[0], axis=-1)
    agree = residuals <= GATE
    if agree.sum() < MIN_POINTS:
        reason = f"only {int(agree.sum())} points agree on one pose, {MIN_POINTS} are needed"
        return replace(nothing, reason=reason)
    T = make_transform(rotation, size * translation - rotation @ centre)
    return PnPResult(T, float(np.sqrt(np.mean((residuals * sigma)[agree] ** 2))), agree)


def _degenerate(
    object_points: Float[np.ndarray, "n 3"],
    image_points: Float[np.ndarray, "n 2"],
    sigma: Float[np.ndarray, "n"],
) -> str:
    """Say why these points cannot fix a pose, or return an empty string."""
    if len(object_points) < MIN_POINTS:
        return f"only {len(object_points)} usable points, {MIN_POINTS} are needed"
    extent = np.ptp(object_points, axis=0).max()
    if not 1e-9 < extent < 1e9:
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


def _best_pose(points: Correspondences) -> Pose | None:
    """Refine starts and return the plausible pose of the smallest truncated cost.

    All points are tried first; where not all of them agree on that pose, subsets are.
    """
    everything = list(range(len(points.rays)))
    whole = _sqpnp(points, [everything])
    normal = _thin_axis(points.object_points)
    starts = [*whole, *(_mirrored(pose, normal) for pose in whole if normal is not None)]
    best = _refined(points, starts)
    if best and _costs(points, best)[1][0] == len(everything):
        return best[0]
    best += _refined(points, _subset_starts(points, everything))
    return best[int(_costs(points, best)[0].argmin())] if best else None


def _refined(points: Correspondences, starts: list[Pose]) -> list[Pose]:
    """Refine all starts together; return the plausible results, best first."""
    if not starts:
        return []
    rotations, translations = (np.stack(block) for block in zip(*starts, strict=True))
    refined = list(zip(*refine(points, rotations, translations), strict=True))
    cost, _ = _costs(points, refined)
    return [refined[k] for k in np.argsort(cost) if _plausible(points, refined[k])]


def _subset_starts(points: Correspondences, everything: list[int]) -> list[Pose]:
    """Return the best poses from all points but one and all points but two.

    The second point to leave out is looked for only beside the best first ones: a pose without one
    of two outliers is closer to the truth than a pose without neither.
    """
    singles = _solve_without(points, [{k} for k in everything])
    pairs = {frozenset(out | {k}) for out, _ in singles[:NUM_SUBSET_STARTS] for k in everything}
    doubles = _solve_without(points, sorted((pair for pair in pairs if len(pair) == 2), key=sorted))
    solved = [pose for _, pose in singles + doubles]
    if not solved:
        return []
    return [solved[k] for k in _costs(points, solved)[0].argsort()[:NUM_SUBSET_STARTS]]


def _plausible(
    points: Correspondences,
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, "3"],
) -> bool:
    """Tell a sound pose: finite, a rotation, all points in front and at a believable distance."""
    if not is_rotation(rotation, tolerance=1e-6):
        return False
    depth = points.object_points @ rotation[2] + translation[2]
    return bool((depth > 0).all() and np.linalg.norm(translation) <= MAX_DISTANCE)


def _thin_axis(object_points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"] | None:
    """Return the unit normal of a plate; None for a thicker part, which has no second tilt."""
    _, extents, axes = np.linalg.svd(object_points - object_points.mean(0))
    return axes[2] if extents[2] < PLATE * extents[0] else None


def _mirrored(pose: Pose, normal: Float[np.ndarray, "3"]) -> Pose:
    """Return the other tilt under which a plate looks almost the same.

    Seen from far away, a plate tilted by +θ and by −θ about the same axis have the same image. The
    second is the first reflected in the plane across the viewing ray r and, since a reflection is
    no rotation, also in the plate's own plane with normal n: R' = (I − 2rrᵀ) R (I − 2nnᵀ).
    """
    rotation, translation = pose
    ray = translation / np.linalg.norm(translation)
    across = np.eye(3) - 2 * np.outer(ray, ray)
    return across @ rotation @ (np.eye(3) - 2 * np.outer(normal, normal)), translation
