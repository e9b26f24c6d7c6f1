"""Distances between the surfaces of an object at two poses: ADD, ADD-S, MSSD; metres."""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.metrics.functional.inputs import check_poses, check_symmetries, chunks, nan_is_miss
from dopepp.metrics.functional.nearest import NearestPoints
from dopepp.metrics.functional.symmetric import least_farthest

_CHUNK_PAIRS: Final = 1 << 26
"""Pairs of points held at once on a GPU: 0.5 GB in float64."""


def add(
    R_est: Float[Tensor, "n 3 3"],
    t_est: Float[Tensor, "n 3"],
    R_gt: Float[Tensor, "n 3 3"],
    t_gt: Float[Tensor, "n 3"],
    points: Float[Tensor, "v 3"],
) -> Float[Tensor, "n"]:
    """Average distance between corresponding points at both poses (ADD, paper Eq. 1), metres.

    Raises:
        ValueError: A shape is wrong or there are no points.
    """
    R_est, t_est, R_gt, t_gt, points = check_poses(R_est, t_est, R_gt, t_gt, points)
    # R_est·x + t_est − R_gt·x − t_gt needs one product instead of two.
    rotation, translation = R_est - R_gt, t_est - t_gt
    errors = t_est.new_empty(len(t_est))
    for chunk in chunks(len(t_est), len(points)):
        errors[chunk] = _lengths(rotation[chunk], translation[chunk], points).mean(dim=1)
    return nan_is_miss(errors)


def add_s(
    R_est: Float[Tensor, "n 3 3"],
    t_est: Float[Tensor, "n 3"],
    R_gt: Float[Tensor, "n 3 3"],
    t_gt: Float[Tensor, "n 3"],
    points: Float[Tensor, "v 3"],
) -> Float[Tensor, "n"]:
    """Average distance from each true point to the nearest ESTIMATED point (ADD-S), metres.

    Exact, for symmetric objects: one tree over the object's points serves all poses on a CPU; on a
    GPU every pair of points is compared.

    Raises:
        ValueError: A shape is wrong or there are no points.
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
    R_est: Float[Tensor, "n 3 3"],
    R_gt: Float[Tensor, "n 3 3"],
    offset: Float[Tensor, "n 3"],
    points: Float[Tensor, "v 3"],
) -> Float[Tensor, "n"]:
    """Average the distances to the nearest points by comparing every pair: ADD-S for a GPU.

    Args:
        R_est: Estimated rotations.
        R_gt: True rotations.
        offset: True minus estimated translation, metres.
        points: Object frame, metres.
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
    R_est: Float[Tensor, "n 3 3"],
    t_est: Float[Tensor, "n 3"],
    R_gt: Float[Tensor, "n 3 3"],
    t_gt: Float[Tensor, "n 3"],
    points: Float[Tensor, "v 3"],
    symmetries: Float[Tensor, "s 4 4"] | None = None,
) -> Float[Tensor, "n"]:
    """Maximum symmetry-aware surface distance, metres (MSSD; Drost et al. 2017, BOP 2019).

    min over S of max over x of ‖(R̂x + t̂) − (R(Sx) + t)‖.

    Args:
        R_est: Estimated rotations.
        t_est: Estimated translations, metres.
        R_gt: True rotations.
        t_gt: True translations, metres.
        points: Object frame, metres.
        symmetries: The transforms S, taken as they are: put the identity among them, as
            :func:`dopepp.geometry.symmetry.symmetry_group` does. (S, 3, 3) are rotations.

    Raises:
        ValueError: A shape is wrong or there are no points.
    """
    R_est, t_est, R_gt, t_gt, points = check_poses(R_est, t_est, R_gt, t_gt, points)
    group = check_symmetries(symmetries, t_est)
    return least_farthest((R_est, t_est), (R_gt, t_gt), points, group, perspective=False)


def _lengths(
    rotation: Float[Tensor, "n 3 3"], translation: Float[Tensor, "n 3"], points: Tensor
) -> Float[Tensor, "n v"]:
    """Return ‖A x + b‖ of every point for every pair (A, b)."""
    offsets = torch.baddbmm(
        translation[..., None], rotation, points.T.expand(len(rotation), *points.T.shape)
    )
    return offsets.square_().sum(dim=1).sqrt_()
