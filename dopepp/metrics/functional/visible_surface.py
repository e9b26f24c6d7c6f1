"""Visible surface discrepancy: what a depth camera sees of an object at two poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dopepp.errors import UserError
from dopepp.metrics.functional.inputs import check_cameras, to_float64

VISIBILITY_TOLERANCE: Final = 0.015
"""Metres by which a surface may lie behind the measured one and still count as visible (BOP)."""


def vsd(
    depth_est: Float[Tensor, "n height width"],
    depth_gt: Float[Tensor, "n height width"],
    depth_test: Float[Tensor, "n height width"],
    K: Float[Tensor, "*n 3 3"],
    taus: Sequence[float],
    delta: float = VISIBILITY_TOLERANCE,
    diameter: float | None = None,
) -> Float[Tensor, "n taus"]:
    """Visible surface discrepancy with the step cost (VSD; Hodaň et al. 2016, as in BOP 2019).

    The depths are turned into distances D from the camera's centre. A pixel of the object at the
    true pose is visible where D_gt − D_test ≤ delta or the sensor measured nothing; one at the
    estimated pose where the same holds for D_est, or where the object is visible at the true pose.
    The error is the share of the pixels visible at either pose that are not visible at both, or
    whose distances differ by tau or more.

    Args:
        depth_est: Depth of the object alone at the estimated pose, metres along z; 0 elsewhere.
        depth_gt: The same at the true pose.
        depth_test: What the sensor measured; 0 where it measured nothing.
        K: One camera matrix, or one for every image; pixels.
        taus: Tolerances of the distance, metres; shares of the diameter where that is given.
        delta: Tolerance of the visibility, metres.
        diameter: Of the object, metres.

    Returns:
        The error in [0, 1] for every tolerance; 1 where nothing is visible at either pose.

    Raises:
        ValueError: The shapes differ.
        UserError: There is no tau, or a tau, delta or the diameter is not positive.
    """
    scale = 1.0 if diameter is None else diameter
    if not taus or not all(value > 0 for value in (*taus, delta, scale)):
        raise UserError(
            f"taus {list(taus)}, delta {delta}, diameter {diameter}",
            "one or more taus, and all positive",
            "give tolerances in metres",
        )
    depths = [to_float64(depth) for depth in (depth_est, depth_gt, depth_test)]
    if depths[0].ndim != 3 or any(depth.shape != depths[0].shape for depth in depths):
        shapes = [tuple(depth.shape) for depth in depths]
        raise ValueError(f"depths must be (N, height, width) of one shape, got {shapes}")
    K = check_cameras(K, len(depths[0]))
    est, gt, test = (_distances(depth, K) for depth in depths)
    visible_gt = _visible(gt, test, delta)
    visible_est = _visible(est, test, delta) | (visible_gt & (est > 0))
    both, either = visible_gt & visible_est, (visible_gt | visible_est).sum(dim=(1, 2))
    difference = torch.where(both, (gt - est).abs() / scale, torch.inf)
    right = [(difference < tau).sum(dim=(1, 2)) for tau in taus]
    errors = 1 - torch.stack(right, dim=1) / either[:, None].clamp(min=1)
    return errors.double()


def _distances(
    depth: Float[Tensor, "n height width"], K: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n height width"]:
    """Turn depths along z into distances from the camera's centre."""
    height, width = depth.shape[1:]
    y, x = torch.meshgrid(
        torch.arange(height, dtype=depth.dtype, device=depth.device),
        torch.arange(width, dtype=depth.dtype, device=depth.device),
        indexing="ij",
    )
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1).reshape(1, -1, 3)
    rays = (pixels @ torch.linalg.inv(K).mT).reshape(len(K), height, width, 3)
    distance: Tensor = depth * torch.linalg.vector_norm(rays, dim=-1)
    return distance


def _visible(
    model: Float[Tensor, "n height width"], test: Float[Tensor, "n height width"], delta: float
) -> Bool[Tensor, "n height width"]:
    return (model > 0) & ((model - test <= delta) | (test == 0))
