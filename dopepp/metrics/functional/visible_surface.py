"""Visible surface discrepancy: what a depth camera sees of an object at two poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dopepp.core.errors import UserError
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
    # Pixels without the object at either pose are visible at neither.
    pixels = ((depths[0] > 0) | (depths[1] > 0)).nonzero(as_tuple=True)
    image, y, x = pixels
    lengths = _ray_lengths(image, y, x, K)
    est, gt, test = (depth[pixels] * lengths for depth in depths)
    visible_gt = _visible(gt, test, delta)
    visible_est = _visible(est, test, delta) | (visible_gt & (est > 0))
    both, either = visible_gt & visible_est, visible_gt | visible_est
    difference = torch.where(both, (gt - est).abs() / scale, torch.inf)

    def count(chosen: Bool[Tensor, "pixels"]) -> Float[Tensor, "n"]:
        return torch.bincount(image[chosen], minlength=len(K)).double()

    right = torch.stack([count(difference < tau) for tau in taus], dim=1)
    return 1 - right / count(either)[:, None].clamp(min=1)


def _ray_lengths(
    image: Int[Tensor, "pixels"],
    y: Int[Tensor, "pixels"],
    x: Int[Tensor, "pixels"],
    K: Float[Tensor, "n 3 3"],
) -> Float[Tensor, "pixels"]:
    """Return the distance from the camera's centre of a point at depth 1 behind each pixel.

    Args:
        image: Image of each pixel.
        y: Its row.
        x: Its column.
        K: Camera matrix of every image.
    """
    columns = torch.linalg.inv(K)[image].unbind(dim=2)
    rays = columns[0] * x[:, None] + columns[1] * y[:, None] + columns[2]
    lengths: Tensor = torch.linalg.vector_norm(rays, dim=1)
    return lengths


def _visible(
    model: Float[Tensor, "pixels"], test: Float[Tensor, "pixels"], delta: float
) -> Bool[Tensor, "pixels"]:
    return (model > 0) & ((model - test <= delta) | (test == 0))
