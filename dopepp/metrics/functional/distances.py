"""Errors of poses: on the object's surface, in the image, in orientation and in position."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from dopepp.geometry.camera import CameraMatrix
from dopepp.metrics.functional.point_search import least_farthest, mean_nearest

Rotations = Float[Tensor, "n 3 3"]
Positions = Float[Tensor, "n 3"]
Points = Float[Tensor, "v 3"]
Symmetries = Float[Tensor, "s 4 4"]
Errors = Float[Tensor, "n"]
"""N poses and their errors (infinite for a miss), V points of one object; metres."""

BOP_THRESHOLDS: Final = tuple(round(0.05 * k, 2) for k in range(1, 11))
"""Thresholds of MSSD, and tolerances of VSD, in diameters, 0.05 to 0.5 (BOP)."""

BOP_MSPD_THRESHOLDS: Final = tuple(5.0 * k for k in range(1, 11))
"""Thresholds of MSPD in pixels of a 640-pixel-wide image, 5 to 50 (BOP)."""

Depths = Float[np.ndarray, "height width"]

VSD_DELTA: Final = 0.015
"""Largest distance of a visible surface behind the measured depth, metres."""

_CHUNK_POINTS: Final = 1 << 17
"""Number of points transformed at once: 3 MB in float64, which fits into a CPU's cache."""


def add(
    R_est: Rotations, t_est: Positions, R_gt: Rotations, t_gt: Positions, points: Points
) -> Errors:
    """Return the mean distance between corresponding points at both poses (ADD), metres.

    Args:
        R_est: Estimated rotations from object to camera frame.
        t_est: Estimated translations, metres.
        R_gt: True rotations.
        t_gt: True translations, metres.
        points: ADD points in the object frame, metres.
    """
    R_est, t_est, R_gt, t_gt, points = _checked(R_est, t_est, R_gt, t_gt, points)
    # (R_est − R_gt)·x + (t_est − t_gt) needs a single matrix product.
    rotation, translation = R_est - R_gt, t_est - t_gt
    errors = t_est.new_empty(len(t_est))
    for chunk in _chunks(len(t_est), len(points)):
        repeated = points.T.expand(len(rotation[chunk]), *points.T.shape)
        offsets = torch.baddbmm(translation[chunk][..., None], rotation[chunk], repeated)
        errors[chunk] = offsets.square_().sum(dim=1).sqrt_().mean(dim=1)
    return nan_is_miss(errors)


def add_s(
    R_est: Rotations, t_est: Positions, R_gt: Rotations, t_gt: Positions, points: Points
) -> Errors:
    """Return the mean distance from true points to the nearest estimated points (ADD-S), metres.

    The arguments are as in :func:`add`.
    """
    R_est, t_est, R_gt, t_gt, points = _checked(R_est, t_est, R_gt, t_gt, points)
    valid = _all_finite(R_est, t_est, R_gt, t_gt)
    poses = (tensor[valid].cpu().numpy() for tensor in (R_est, R_gt, t_gt - t_est))
    errors = torch.full_like(t_est[:, 0], torch.inf)
    errors[valid] = torch.from_numpy(mean_nearest(points.cpu().numpy(), *poses)).to(errors)
    return errors


def mssd(
    R_est: Rotations,
    t_est: Positions,
    R_gt: Rotations,
    t_gt: Positions,
    points: Points,
    symmetries: Symmetries | None = None,
) -> Errors:
    """Return the maximum symmetry-aware surface distance, metres (MSSD; Drost 2017, BOP 2019).

    The formula is min over S of max over x of ‖(R̂x + t̂) − (R(Sx) + t)‖. ``symmetries`` are the
    transforms S, (S, 4, 4) or (S, 3, 3), which must contain the identity (see
    :func:`dopepp.geometry.symmetry.symmetry_group`); None for the identity alone. The other
    arguments are as in :func:`add`.
    """
    R_est, t_est, R_gt, t_gt, points = _checked(R_est, t_est, R_gt, t_gt, points)
    group = _check_symmetries(symmetries, t_est)
    return least_farthest((R_est, t_est), (R_gt, t_gt), points, group, perspective=False)


def reprojection_error(
    R_est: Rotations,
    t_est: Positions,
    R_gt: Rotations,
    t_gt: Positions,
    points: Points,
    K: Float[Tensor, "*n 3 3"],
) -> Errors:
    """Return the mean distance between the points' projections at both poses, pixels.

    The error is infinite if a point lies at or behind the camera in either pose. ``K`` is a camera
    matrix for all poses (3, 3) or for each pose (N, 3, 3), pixels.
    """
    R_est, t_est, R_gt, t_gt, points = _checked(R_est, t_est, R_gt, t_gt, points)
    K = _check_cameras(K, len(R_est))
    errors = t_est.new_empty(len(t_est))
    for chunk in _chunks(len(t_est), len(points)):
        estimated = project_points(R_est[chunk], t_est[chunk], points, K[chunk])
        true = project_points(R_gt[chunk], t_gt[chunk], points, K[chunk])
        errors[chunk] = (estimated - true).norm(dim=2).mean(dim=1)
    return nan_is_miss(errors)


def mspd(
    R_est: Rotations,
    t_est: Positions,
    R_gt: Rotations,
    t_gt: Positions,
    points: Points,
    K: Float[Tensor, "*n 3 3"],
    symmetries: Symmetries | None = None,
) -> Errors:
    """Return the maximum symmetry-aware projection distance, pixels (MSPD; BOP 2019).

    The formula is min over S of max over x of ‖π(R̂x + t̂) − π(R(Sx) + t)‖. The distance is infinite
    if a point lies at or behind the camera. ``K`` is as in :func:`reprojection_error`; the other
    arguments are as in :func:`mssd`.
    """
    R_est, t_est, R_gt, t_gt, points = _checked(R_est, t_est, R_gt, t_gt, points)
    to_pixels = _check_cameras(K, len(R_est))
    estimated, true = (
        (to_pixels @ R, (to_pixels @ t[..., None])[..., 0])
        for R, t in ((R_est, t_est), (R_gt, t_gt))
    )
    group = _check_symmetries(symmetries, t_est)
    return least_farthest(estimated, true, points, group, perspective=True)


def project_points(
    R: Float[Tensor, "*n 3 3"],
    t: Float[Tensor, "*n 3"],
    points: Float[Tensor, "*#n v 3"],
    K: Float[Tensor, "*#n 3 3"],
) -> Float[Tensor, "*n v 2"]:
    """Project points (object frame, metres) at poses to pixels; NaN at or behind the camera."""
    cam = points @ R.mT + t[..., None, :]
    depth = cam[..., 2:]
    rays = torch.where(depth > 0, cam / depth, torch.nan)
    return (rays @ K.mT)[..., :2]


def rotation_error_deg(
    R_est: Rotations, R_gt: Rotations, symmetries: Symmetries | None = None
) -> Errors:
    """Return the angle between two orientations, degrees in [0, 180].

    With ``symmetries`` (as in :func:`mssd`), return the smallest angle to any R_gt·S.

    Raises:
        ValueError: An array has an unexpected shape.
    """
    R_est, R_gt = to_float64(R_est), to_float64(R_gt)
    if R_est.shape != R_gt.shape or R_est.shape[1:] != (3, 3):
        shapes = f"{tuple(R_est.shape)} and {tuple(R_gt.shape)}"
        raise ValueError(f"rotations must be (N, 3, 3) and (N, 3, 3), got {shapes}")
    errors = torch.full_like(R_est[:, 0, 0], torch.inf)
    for rotation in _check_symmetries(symmetries, R_est)[0]:
        errors = torch.fmin(errors, _angles_deg(R_est @ (R_gt @ rotation).mT))
    return errors


def _angles_deg(Q: Rotations) -> Errors:
    """Return the angles of rotations by atan2, since arccos is inaccurate near 0° and 180°."""
    axial = torch.stack(
        [Q[:, 2, 1] - Q[:, 1, 2], Q[:, 0, 2] - Q[:, 2, 0], Q[:, 1, 0] - Q[:, 0, 1]], dim=1
    )
    trace = Q.diagonal(dim1=1, dim2=2).sum(dim=1)
    return torch.rad2deg(torch.atan2(axial.norm(dim=1), trace - 1))


def translation_error(t_est: Positions, t_gt: Positions) -> Errors:
    """Return the distance between the two positions of the object's origin, metres."""
    return nan_is_miss((to_float64(t_est) - to_float64(t_gt)).norm(dim=1))


def mahalanobis(
    R_est: Rotations,
    t_est: Positions,
    R_gt: Rotations,
    t_gt: Positions,
    covariance: Float[Tensor, "n 6 6"],
    symmetries: Symmetries | None = None,
) -> Errors:
    """Return the Mahalanobis distance √(δᵀ Σ⁻¹ δ) of the true pose from the estimate.

    ``covariance`` is Σ of the step δ from the estimated to the true pose: a rotation vector about
    the object's origin (radians) and a shift (metres), in camera axes. A singular or non-finite
    covariance gives an infinite distance. With ``symmetries`` (as in :func:`mssd`), the distance is
    the smallest to any equivalent pose. The other arguments are as in :func:`add`.

    Raises:
        ValueError: An array has an unexpected shape.
    """
    R_est, t_est, R_gt, t_gt, _ = _checked(R_est, t_est, R_gt, t_gt, points=torch.zeros(1, 3))
    covariance = to_float64(covariance)
    if covariance.shape != (len(t_est), 6, 6):
        raise ValueError(f"covariance must be (N, 6, 6), got {tuple(covariance.shape)}")
    errors = torch.full_like(t_est[:, 0], torch.inf)
    inputs = (R_est, t_est, R_gt, t_gt, covariance)
    valid = _all_finite(*inputs)
    if not valid.any():
        return errors
    R_est, t_est, R_gt, t_gt, covariance = (tensor[valid] for tensor in inputs)
    for rotation, shift in zip(*_check_symmetries(symmetries, t_est), strict=True):
        rotations = Rotation.from_matrix((R_gt @ rotation @ R_est.mT).cpu().numpy()).as_rotvec()
        shifts = t_gt + R_gt @ shift - t_est
        step = torch.cat([torch.from_numpy(rotations).to(shifts), shifts], dim=1)
        solved, _ = torch.linalg.solve_ex(covariance, step)
        squared = (step * solved).sum(dim=1)
        distances = torch.where(squared >= 0, squared.sqrt(), torch.inf)
        errors[valid] = torch.fmin(errors[valid], distances)
    return nan_is_miss(errors)


def to_float64(array: Tensor) -> Tensor:
    """Return a tensor, array or list as a float64 tensor; tensors keep their device."""
    return torch.as_tensor(array, dtype=torch.float64)


def _all_finite(*tensors: Tensor) -> Bool[Tensor, "n"]:
    """Return for each pose whether all of its numbers are finite."""
    return torch.cat([tensor.flatten(1) for tensor in tensors], dim=1).isfinite().all(dim=1)


def _checked(
    R_est: Tensor, t_est: Tensor, R_gt: Tensor, t_gt: Tensor, points: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Convert poses and points to float64 after checking their shapes."""
    tensors = tuple(map(to_float64, (R_est, t_est, R_gt, t_gt, points)))
    shapes = [tuple(tensor.shape) for tensor in tensors[:4]]
    n = len(tensors[1])
    if shapes != [(n, 3, 3), (n, 3), (n, 3, 3), (n, 3)]:
        raise ValueError(f"poses must be (N, 3, 3), (N, 3), (N, 3, 3), (N, 3), got {shapes}")
    size = tuple(tensors[4].shape)
    if size[1:] != (3,) or not size[0]:
        raise ValueError(f"points must be (V, 3) with V >= 1, got {size}")
    return tensors  # type: ignore[return-value]


def _check_cameras(K: Tensor, num_poses: int) -> Rotations:
    """Check the shape of K (pixels), and return a camera matrix for every pose, (N, 3, 3)."""
    K = to_float64(K)
    if K.shape[-2:] != (3, 3) or K.shape[:-2] not in ((), (num_poses,)):
        raise ValueError(f"K must be (3, 3) or (N, 3, 3) of N = {num_poses}, got {tuple(K.shape)}")
    return K.expand(num_poses, 3, 3)


def _check_symmetries(
    symmetries: Tensor | None, like: Tensor
) -> tuple[Float[Tensor, "s 3 3"], Float[Tensor, "s 3"]]:
    """Split (S, 4, 4) or (S, 3, 3) transforms into rotations and translations."""
    if symmetries is None:
        return torch.eye(3, dtype=like.dtype, device=like.device)[None], like.new_zeros(1, 3)
    symmetries = to_float64(symmetries).to(like.device)
    shape = tuple(symmetries.shape)
    if len(shape) != 3 or shape[1:] not in ((4, 4), (3, 3)) or not shape[0]:
        raise ValueError(f"symmetries must be (S, 4, 4) or (S, 3, 3) with S >= 1, got {shape}")
    if shape[1] == 3:
        return symmetries, symmetries.new_zeros(len(symmetries), 3)
    return symmetries[:, :3, :3], symmetries[:, :3, 3]


def _chunks(num_poses: int, num_points: int) -> Iterator[slice]:
    """Return slices of poses of which each has about ``_CHUNK_POINTS`` points."""
    step = max(1, _CHUNK_POINTS // num_points)
    return (slice(start, start + step) for start in range(0, num_poses, step))


def nan_is_miss(errors: Tensor) -> Tensor:
    """Replace NaN by infinity, the error of a missed pose."""
    return errors.nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=-torch.inf)


def vsd(
    depth_est: Depths, depth_gt: Depths, depth: Depths, K: CameraMatrix, diameter: float
) -> Float[np.ndarray, "10"]:
    """Return the visible surface discrepancy in [0, 1] for BOP's tolerances (VSD; BOP 2019).

    A pixel is wrong if it shows the object at one pose only. It is also wrong if the distances of
    the surface from the camera at both poses differ by at least the tolerance.

    ``depth_est`` and ``depth_gt`` are rendered at both poses, metres along z, 0 outside the object;
    ``depth`` is measured, 0 without a measurement, where every surface is visible. Tolerances are
    :data:`BOP_THRESHOLDS` times the diameter, metres.
    """
    rays = _ray_lengths(K, depth.shape)
    measured, estimated, true = rays * depth, rays * depth_est, rays * depth_gt
    visible_gt = _is_visible(true, measured)
    visible_est = _is_visible(estimated, measured) | (visible_gt & (estimated > 0))
    either, both = visible_gt | visible_est, visible_gt & visible_est
    num_either = int(either.sum())
    if not num_either:
        return np.ones(len(BOP_THRESHOLDS))
    gaps = np.abs(true - estimated)[both] / diameter
    wrong = [int((gaps >= tolerance).sum()) for tolerance in BOP_THRESHOLDS]
    return np.array([(n + num_either - int(both.sum())) / num_either for n in wrong])


def _ray_lengths(K: CameraMatrix, shape: tuple[int, ...]) -> Depths:
    """Return the distance from the camera to each pixel's point at depth 1, metres."""
    rows, columns = np.indices(shape)
    rays = np.linalg.solve(K, np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)]))
    return np.asarray(np.linalg.norm(rays / rays[2], axis=0).reshape(shape))


def _is_visible(distance: Depths, measured: Depths) -> Bool[np.ndarray, "height width"]:
    """Return where a surface is visible: not behind the measured depth, or depth is missing."""
    return np.asarray((distance > 0) & ((distance - measured <= VSD_DELTA) | (measured == 0)))
