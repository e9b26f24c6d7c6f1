"""Distances between the images of an object at two poses; pixels."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.metrics.functional.inputs import (
    check_cameras,
    check_poses,
    check_symmetries,
    chunks,
    nan_is_miss,
)
from dopepp.metrics.functional.symmetric import least_farthest


def reprojection_error(
    R_est: Float[Tensor, "n 3 3"],
    t_est: Float[Tensor, "n 3"],
    R_gt: Float[Tensor, "n 3 3"],
    t_gt: Float[Tensor, "n 3"],
    points: Float[Tensor, "v 3"],
    K: Float[Tensor, "*n 3 3"],
) -> Float[Tensor, "n"]:
    """Average pixel distance between the points' projections at both poses.

    One K serves all poses, or each has its own. A point at or behind the camera in either pose
    makes the error infinite.

    Raises:
        ValueError: A shape is wrong or there are no points.
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
    R_est: Float[Tensor, "n 3 3"],
    t_est: Float[Tensor, "n 3"],
    R_gt: Float[Tensor, "n 3 3"],
    t_gt: Float[Tensor, "n 3"],
    points: Float[Tensor, "v 3"],
    K: Float[Tensor, "*n 3 3"],
    symmetries: Float[Tensor, "s 4 4"] | None = None,
) -> Float[Tensor, "n"]:
    """Maximum symmetry-aware projection distance, pixels (MSPD; BOP 2019).

    min over S of max over x of ‖π(R̂x + t̂) − π(R(Sx) + t)‖. A point at or behind the camera makes
    it infinite.

    Args:
        R_est: Estimated rotations.
        t_est: Estimated translations, metres.
        R_gt: True rotations.
        t_gt: True translations, metres.
        points: Object frame, metres.
        K: One camera matrix, or one for every pose; pixels.
        symmetries: As of :func:`dopepp.metrics.functional.mssd`.

    Raises:
        ValueError: A shape is wrong or there are no points.
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


def _project(
    R: Float[Tensor, "n 3 3"], t: Float[Tensor, "n 3"], points: Tensor, K: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n v 2"]:
    """Project points at poses to pixels; NaN at or behind the camera."""
    cam = points @ R.mT + t[:, None]
    depth = cam[..., 2:]
    rays = torch.where(depth > 0, cam / depth, torch.nan)
    return (rays @ K.mT)[..., :2]
