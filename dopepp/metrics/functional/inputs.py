"""What the pose errors share: their inputs checked, cast and cut into chunks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

Rotations = Float[Tensor, "n 3 3"]
Positions = Float[Tensor, "n 3"]
Points = Float[Tensor, "v 3"]
Symmetries = Float[Tensor, "s 4 4"]
Errors = Float[Tensor, "n"]
"""Of N poses and one object's V points: metres, object frame; errors infinite for a miss."""

_CHUNK_POINTS: Final = 1 << 17
"""Transformed points held at once: 3 MB in float64, which stays in a CPU's cache."""


def to_float64(array: Tensor) -> Tensor:
    """Return any array as a float64 tensor on its own device."""
    return torch.as_tensor(array, dtype=torch.float64)


def check_poses(
    R_est: Tensor, t_est: Tensor, R_gt: Tensor, t_gt: Tensor, points: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Cast to float64 and insist on the shapes that broadcasting would otherwise hide.

    A wrong shape, or no points, are a ``ValueError``.
    """
    R_est, t_est, R_gt, t_gt, points = map(to_float64, (R_est, t_est, R_gt, t_gt, points))
    n = len(t_est)
    shapes = [tuple(tensor.shape) for tensor in (R_est, t_est, R_gt, t_gt)]
    if shapes != [(n, 3, 3), (n, 3), (n, 3, 3), (n, 3)]:
        raise ValueError(f"poses must be (N, 3, 3), (N, 3), (N, 3, 3), (N, 3), got {shapes}")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points must be (V, 3) with V >= 1, got {tuple(points.shape)}")
    return R_est, t_est, R_gt, t_gt, points


def check_cameras(K: Tensor, num_poses: int) -> Rotations:
    """Return one camera matrix for every pose; K must be (3, 3) or (N, 3, 3)."""
    K = to_float64(K)
    if K.shape[-2:] != (3, 3) or K.shape[:-2] not in ((), (num_poses,)):
        raise ValueError(f"K must be (3, 3) or (N, 3, 3) of N = {num_poses}, got {tuple(K.shape)}")
    return K.expand(num_poses, 3, 3)


def check_symmetries(
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


def chunks(num_poses: int, num_points: int) -> Iterator[slice]:
    """Cut poses into slices that need little memory with ``num_points`` points each."""
    step = max(1, _CHUNK_POINTS // num_points)
    return (slice(i, min(i + step, num_poses)) for i in range(0, num_poses, step))


def nan_is_miss(errors: Tensor) -> Tensor:
    """Turn NaN into an infinite error."""
    return errors.nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=-torch.inf)
