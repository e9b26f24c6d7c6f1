"""How far a pose is off: on the object's surface, in its image, in orientation and position."""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.metrics.functional.inputs import (
    Errors,
    Points,
    Positions,
    Rotations,
    Symmetries,
    check_cameras,
    check_poses,
    check_symmetries,
    chunks,
    nan_is_miss,
    to_float64,
)
from dopepp.metrics.functional.nearest import NearestPoints
from dopepp.metrics.functional.symmetric import least_farthest

_CHUNK_PAIRS: Final = 1 << 26
"""Pairs of points held at once on a GPU: 0.5 GB in float64."""


def add(
    R_est: Rotations, t_est: Positions, R_gt: Rotations, t_gt: Positions, points: Points
) -> Errors:
    """Average distance between corresponding points at both poses (ADD, paper Eq. 1), metres."""
    R_est, t_est, R_gt, t_gt, points = check_poses(R_est, t_est, R_gt, t_gt, points)
    # R_est·x + t_est − R_gt·x − t_gt needs one product instead of two.
    rotation, translation = R_est - R_gt, t_est - t_gt
    errors = t_est.new_empty(len(t_est))
    for chunk in chunks(len(t_est), len(points)):
        errors[chunk] = _lengths(rotation[chunk], translation[chunk], points).mean(dim=1)
    return nan_is_miss(errors)


def add_s(
    R_est: Rotations, t_est: Positions, R_gt: Rotations, t_gt: Positions, points: Points
) -> Errors:
    """Average distance from each true point to the nearest ESTIMATED point (ADD-S), metres.

    Exact, for symmetric objects: one tree over the object's points serves all poses on a CPU; on a
    GPU every pair of points is compared.
    """
    R_est, t_est, R_gt, t_gt, points = check_poses(R_est, t_est, R_gt, t_gt, points)
    everything = torch.cat([R_est.flatten(1), t_est, R_gt.flatten(1), t_gt], dim=1)
    valid = everything.isfinite().all(dim=1).nonzero()[:, 0]
    errors = torch.full_like(t_est[:, 0], torch.inf)
    if t_est.device.type == "cpu":
        nearest = NearestPoints(points.numpy())
        distances = nearest.mean_distances(
            *(tensor[valid].numpy() for tensor in (R_est, R_gt, t_gt - t_est))
        )
        errors[valid] = torch.from_numpy(distances)
    else:
        errors[valid] = compare_all_pairs(R_est[valid], R_gt[valid], (t_gt - t_est)[valid], points)
    return errors


def compare_all_pairs(
    R_est: Rotations, R_gt: Rotations, offset: Positions, points: Points
) -> Errors:
    """Average the distances to the nearest points by comparing every pair: ADD-S for a GPU.

    ``offset`` is the true minus the estimated translation, metres.
    """
    errors = offset.new_empty(len(offset))
    rows = max(1, _CHUNK_PAIRS // len(points))
    for n in range(len(offset)):
        estimated, true = points @ R_est[n].mT, points @ R_gt[n].mT + offset[n]
        total = offset.new_zeros(())
        for part in torch.split(true, rows):
            # The matrix product's shortcut loses half of the digits of a small distance.
            pairs = torch.cdist(part, estimated, compute_mode="donot_use_mm_for_euclid_dist")
            total += pairs.amin(dim=1).sum()
        errors[n] = total / len(points)
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
    R_est, t_est, R_gt, t_gt, points = check_poses(R_est, t_est, R_gt, t_gt, points)
    group = check_symmetries(symmetries, t_est)
    return least_farthest((R_est, t_est), (R_gt, t_gt), points, group, perspective=False)


def _lengths(rotation: Rotations, translation: Positions, points: Tensor) -> Float[Tensor, "n v"]:
    """Return ‖A x + b‖ of every point for every pair (A, b)."""
    offsets = torch.baddbmm(
        translation[..., None], rotation, points.T.expand(len(rotation), *points.T.shape)
    )
    return offsets.square_().sum(dim=1).sqrt_()


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
    R_est, t_est, R_gt, t_gt, points = check_poses(R_est, t_est, R_gt, t_gt, points)
    K = check_cameras(K, len(R_est))
    errors = t_est.new_empty(len(t_est))
    for chunk in chunks(len(t_est), len(points)):
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
    R_est, t_est, R_gt, t_gt, points = check_poses(R_est, t_est, R_gt, t_gt, points)
    K = check_cameras(K, len(R_est))
    group = check_symmetries(symmetries, t_est)
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
    turns, _ = check_symmetries(symmetries, R_est)
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
