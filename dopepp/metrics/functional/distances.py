"""How far a pose is off: on the object's surface, in its image, in orientation and position.

VSD is how much of the surface that a camera can see is elsewhere at the estimated pose (BOP).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
"""Of N poses and one object's V points: metres, object frame; errors infinite for a miss."""

BOP_THRESHOLDS: Final = tuple(round(0.05 * k, 2) for k in range(1, 11))
"""0.05 to 0.5: of MSSD, times the diameter (BOP)."""

BOP_MSPD_THRESHOLDS: Final = tuple(5.0 * k for k in range(1, 11))
"""5 to 50 pixels: of MSPD in an image 640 pixels wide; times width/640 in others (BOP)."""

Depths = Float[np.ndarray, "height width"]

VSD_DELTA: Final = 0.015
"""Metres by which a surface may lie behind what a depth camera has measured and still be seen."""

_CHUNK_POINTS: Final = 1 << 17
"""Transformed points held at once: 3 MB in float64, which stays in a CPU's cache."""


def add(
    R_est: Rotations, t_est: Positions, R_gt: Rotations, t_gt: Positions, points: Points
) -> Errors:
    """Average distance between corresponding points at both poses (ADD, paper Eq. 1), metres."""
    R_est, t_est, R_gt, t_gt = _check_poses(R_est, t_est, R_gt, t_gt)
    points = _check_points(points)
    # R_est·x + t_est − R_gt·x − t_gt needs one product instead of two.
    rotation, translation = R_est - R_gt, t_est - t_gt
    errors = t_est.new_empty(len(t_est))
    for chunk in _chunks(len(t_est), len(points)):
        each = points.T.expand(len(rotation[chunk]), *points.T.shape)
        offsets = torch.baddbmm(translation[chunk][..., None], rotation[chunk], each)
        errors[chunk] = offsets.square_().sum(dim=1).sqrt_().mean(dim=1)
    return nan_is_miss(errors)


def add_s(
    R_est: Rotations, t_est: Positions, R_gt: Rotations, t_gt: Positions, points: Points
) -> Errors:
    """Average distance from each true point to the nearest ESTIMATED point (ADD-S), metres.

    Exact, for symmetric objects; one tree over the object's points serves all poses.
    """
    R_est, t_est, R_gt, t_gt = _check_poses(R_est, t_est, R_gt, t_gt)
    points = _check_points(points)
    everything = torch.cat([R_est.flatten(1), t_est, R_gt.flatten(1), t_gt], dim=1)
    valid = everything.isfinite().all(dim=1).nonzero()[:, 0]
    errors = torch.full_like(t_est[:, 0], torch.inf)
    poses = (tensor[valid].cpu().numpy() for tensor in (R_est, R_gt, t_gt - t_est))
    distances = mean_nearest(points.cpu().numpy(), *poses)
    errors[valid] = torch.from_numpy(distances).to(errors)
    return errors


def mssd(
    R_est: Rotations,
    t_est: Positions,
    R_gt: Rotations,
    t_gt: Positions,
    points: Points,
    symmetries: Symmetries | None = None,
) -> Errors:
    """Maximum symmetry-aware surface distance, metres (MSSD; Drost et al. 2017, BOP 2019).

    min over S of max over x of ‖(R̂x + t̂) − (R(Sx) + t)‖.

    The transforms S are taken as they are: put the identity among them, as
    :func:`dopepp.geometry.symmetry.symmetry_group` does. (S, 3, 3) are rotations.
    """
    R_est, t_est, R_gt, t_gt = _check_poses(R_est, t_est, R_gt, t_gt)
    points = _check_points(points)
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
    """Average pixel distance between the points' projections at both poses.

    One K serves all poses, or each has its own. A point at or behind the camera in either pose
    makes the error infinite.
    """
    R_est, t_est, R_gt, t_gt = _check_poses(R_est, t_est, R_gt, t_gt)
    points = _check_points(points)
    K = _check_cameras(K, len(R_est))
    errors = t_est.new_empty(len(t_est))
    for chunk in _chunks(len(t_est), len(points)):
        estimated = _project(R_est[chunk], t_est[chunk], points, K[chunk])
        true = _project(R_gt[chunk], t_gt[chunk], points, K[chunk])
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
    """Maximum symmetry-aware projection distance, pixels (MSPD; BOP 2019).

    min over S of max over x of ‖π(R̂x + t̂) − π(R(Sx) + t)‖. A point at or behind the camera makes
    it infinite. K is one camera matrix, or one for every pose, pixels; symmetries are as of
    :func:`dopepp.metrics.functional.mssd`.
    """
    R_est, t_est, R_gt, t_gt = _check_poses(R_est, t_est, R_gt, t_gt)
    points = _check_points(points)
    K = _check_cameras(K, len(R_est))
    group = _check_symmetries(symmetries, t_est)
    # Pixels are the first two of K·x over x's depth, whatever the last row of K holds.
    to_pixels = K.clone()
    to_pixels[:, 2] = K.new_tensor([0.0, 0.0, 1.0])
    estimated, true = (
        (to_pixels @ R, (to_pixels @ t[..., None])[..., 0])
        for R, t in ((R_est, t_est), (R_gt, t_gt))
    )
    return least_farthest(estimated, true, points, group, perspective=True)


def _project(R: Rotations, t: Positions, points: Tensor, K: Rotations) -> Float[Tensor, "n v 2"]:
    """Project points at poses to pixels; NaN at or behind the camera."""
    cam = points @ R.mT + t[:, None]
    depth = cam[..., 2:]
    rays = torch.where(depth > 0, cam / depth, torch.nan)
    return (rays @ K.mT)[..., :2]


def rotation_error_deg(
    R_est: Rotations, R_gt: Rotations, symmetries: Symmetries | None = None
) -> Errors:
    """Angle of the rotation between two orientations, degrees in [0, 180].

    ``atan2(|axial vector|, trace − 1)`` keeps its digits near 0° and 180°, where arccos loses half.

    With symmetries it is the smallest angle to R_gt·S of these transforms; they are taken as they
    are, so put the identity among them. (S, 3, 3) are rotations.
    """
    R_est, R_gt = to_float64(R_est), to_float64(R_gt)
    if R_est.shape != R_gt.shape or R_est.shape[1:] != (3, 3):
        shapes = f"{tuple(R_est.shape)} and {tuple(R_gt.shape)}"
        raise ValueError(f"rotations must be (N, 3, 3) and (N, 3, 3), got {shapes}")
    turns, _ = _check_symmetries(symmetries, R_est)
    errors = torch.full_like(R_est[:, 0, 0], torch.inf)
    for turn in turns:
        errors = torch.fmin(errors, _angles_deg(R_est @ (R_gt @ turn).mT))
    return errors


def _angles_deg(Q: Rotations) -> Errors:
    axial = torch.stack(
        [Q[:, 2, 1] - Q[:, 1, 2], Q[:, 0, 2] - Q[:, 2, 0], Q[:, 1, 0] - Q[:, 0, 1]], dim=1
    )
    trace = Q.diagonal(dim1=1, dim2=2).sum(dim=1)
    return torch.rad2deg(torch.atan2(axial.norm(dim=1), trace - 1))


def translation_error(t_est: Positions, t_gt: Positions) -> Errors:
    """Distance between the two positions of the object's origin, metres."""
    return nan_is_miss((to_float64(t_est) - to_float64(t_gt)).norm(dim=1))


def mahalanobis(
    R_est: Rotations,
    t_est: Positions,
    R_gt: Rotations,
    t_gt: Positions,
    covariance: Float[Tensor, "n 6 6"],
    symmetries: Symmetries | None = None,
) -> Errors:
    """How many of an estimate's own standard deviations the true pose is away, √(δᵀ Σ⁻¹ δ).

    The step δ leads from the estimated to the true pose: a turn about the object's origin (rotation
    vector) and a shift, camera axes, radians and metres; Σ is its covariance. It is infinite, too,
    where a covariance is not finite or is singular. Of symmetries, which are as of
    :func:`dopepp.metrics.functional.mssd`, the nearest counts.
    """
    R_est, t_est, R_gt, t_gt = _check_poses(R_est, t_est, R_gt, t_gt)
    covariance = to_float64(covariance)
    if covariance.shape != (len(t_est), 6, 6):
        raise ValueError(f"covariance must be (N, 6, 6), got {tuple(covariance.shape)}")
    errors = torch.full_like(t_est[:, 0], torch.inf)
    inputs = (R_est, t_est, R_gt, t_gt, covariance)
    is_finite = torch.cat([tensor.flatten(1) for tensor in inputs], 1).isfinite().all(dim=1)
    if not is_finite.any():
        return errors
    R_est, t_est, R_gt, t_gt, covariance = (tensor[is_finite] for tensor in inputs)
    for turn, shift in zip(*_check_symmetries(symmetries, t_est), strict=True):
        turns = Rotation.from_matrix((R_gt @ turn @ R_est.mT).cpu().numpy()).as_rotvec()
        shifts = t_gt + R_gt @ shift - t_est
        step = torch.cat([torch.from_numpy(turns).to(shifts), shifts], dim=1)
        solved, _ = torch.linalg.solve_ex(covariance, step)
        squared = (step * solved).sum(dim=1)
        away = torch.where(squared >= 0, squared.sqrt(), torch.inf)
        errors[is_finite] = torch.fmin(errors[is_finite], away)
    return nan_is_miss(errors)


def to_float64(array: Tensor) -> Tensor:
    """Return any array as a float64 tensor on its own device."""
    return torch.as_tensor(array, dtype=torch.float64)


def _check_poses(
    R_est: Tensor, t_est: Tensor, R_gt: Tensor, t_gt: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cast to float64 and insist on the shapes that broadcasting would otherwise hide.

    A wrong shape is a ``ValueError``.
    """
    R_est, t_est, R_gt, t_gt = map(to_float64, (R_est, t_est, R_gt, t_gt))
    n = len(t_est)
    shapes = [tuple(tensor.shape) for tensor in (R_est, t_est, R_gt, t_gt)]
    if shapes != [(n, 3, 3), (n, 3), (n, 3, 3), (n, 3)]:
        raise ValueError(f"poses must be (N, 3, 3), (N, 3), (N, 3, 3), (N, 3), got {shapes}")
    return R_est, t_est, R_gt, t_gt


def _check_points(points: Tensor) -> Points:
    """Cast to float64; a wrong shape, or no points, are a ``ValueError``."""
    points = to_float64(points)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points must be (V, 3) with V >= 1, got {tuple(points.shape)}")
    return points


def _check_cameras(K: Tensor, num_poses: int) -> Rotations:
    """Return one camera matrix for every pose; K must be (3, 3) or (N, 3, 3)."""
    K = to_float64(K)
    if K.shape[-2:] != (3, 3) or K.shape[:-2] not in ((), (num_poses,)):
        raise ValueError(f"K must be (3, 3) or (N, 3, 3) of N = {num_poses}, got {tuple(K.shape)}")
    return K.expand(num_poses, 3, 3)


def _check_symmetries(
    symmetries: Tensor | None, like: Tensor
) -> tuple[Float[Tensor, "s 3 3"], Float[Tensor, "s 3"]]:
    """Split (S, 4, 4) or (S, 3, 3) transforms into rotations and translations.

    None is the identity alone; any other shape is a ``ValueError``.
    """
    if symmetries is None:
        return torch.eye(3, dtype=like.dtype, device=like.device)[None], like.new_zeros(1, 3)
    symmetries = to_float64(symmetries).to(like.device)
    if symmetries.ndim != 3 or symmetries.shape[1:] not in ((4, 4), (3, 3)) or not len(symmetries):
        raise ValueError(
            f"symmetries must be (S, 4, 4) or (S, 3, 3) with S >= 1, got {tuple(symmetries.shape)}"
        )
    if symmetries.shape[1] == 3:
        return symmetries, symmetries.new_zeros(len(symmetries), 3)
    return symmetries[:, :3, :3], symmetries[:, :3, 3]


def _chunks(num_poses: int, num_points: int) -> Iterator[slice]:
    """Cut poses into slices that need little memory with ``num_points`` points each."""
    step = max(1, _CHUNK_POINTS // num_points)
    return (slice(i, min(i + step, num_poses)) for i in range(0, num_poses, step))


def nan_is_miss(errors: Tensor) -> Tensor:
    """Turn NaN into an infinite error."""
    return errors.nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=-torch.inf)


def vsd(
    depth_est: Depths,
    depth_gt: Depths,
    depth: Depths,
    K: CameraMatrix,
    diameter: float,
    delta: float = VSD_DELTA,
    tolerances: Sequence[float] = BOP_THRESHOLDS,
) -> Float[np.ndarray, "tolerances"]:
    """Visible surface discrepancy, in [0, 1], one for each tolerance (Hodan et al. 2018; BOP 2019).

    Of the pixels that show the object at one of the two poses, that is the share that shows it at
    one of them only, or at distances from the camera that differ by a tolerance or more.

    Args:
        depth_est: Depth of the object alone at the estimated pose, metres along z, 0 beside it.
        depth_gt: The same at the true pose.
        depth: What a depth camera has measured, 0 where it has nothing: there a surface is seen.
        K: Camera matrix, pixels.
        diameter: Of the object, metres.
        delta: Metres by which a surface that is seen may lie behind what was measured.
        tolerances: In diameters.
    """
    rays = _ray_lengths(K, depth.shape)
    measured, estimated, true = rays * depth, rays * depth_est, rays * depth_gt
    seen_gt = _seen(true, measured, delta)
    seen_est = _seen(estimated, measured, delta) | (seen_gt & (estimated > 0))
    either, both = seen_gt | seen_est, seen_gt & seen_est
    num_either = int(either.sum())
    if not num_either:
        return np.ones(len(tolerances))
    apart = np.abs(true - estimated)[both] / diameter
    wrong = [int((apart >= tolerance).sum()) for tolerance in tolerances]
    return np.array([(n + num_either - int(both.sum())) / num_either for n in wrong])


def _ray_lengths(K: CameraMatrix, shape: tuple[int, ...]) -> Depths:
    """Return the distance of every pixel's point at depth 1, metres."""
    rows, columns = np.indices(shape)
    rays = np.linalg.solve(K, np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)]))
    return np.asarray(np.linalg.norm(rays / rays[2], axis=0).reshape(shape))


def _seen(distance: Depths, measured: Depths, delta: float) -> Bool[np.ndarray, "height width"]:
    """Tell where a surface is seen: not behind what was measured, or nothing was."""
    return np.asarray((distance > 0) & ((distance - measured <= delta) | (measured == 0)))
