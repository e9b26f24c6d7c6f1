"""How far a pose is off in orientation and in position."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.metrics.functional.inputs import check_symmetries, nan_is_miss, to_float64


def rotation_error_deg(
    R_est: Float[Tensor, "n 3 3"],
    R_gt: Float[Tensor, "n 3 3"],
    symmetries: Float[Tensor, "s 4 4"] | None = None,
) -> Float[Tensor, "n"]:
    """Angle of the rotation between two orientations, degrees in [0, 180].

    ``atan2(|axial vector|, trace − 1)`` keeps its digits near 0° and 180°, where arccos loses half.

    Args:
        R_est: Estimated rotations.
        R_gt: True rotations.
        symmetries: Where given, the smallest angle to R_gt·S of these transforms; taken as they
            are, so put the identity among them. (S, 3, 3) are rotations.

    Raises:
        ValueError: A shape is wrong.
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


def _angles_deg(Q: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n"]:
    axial = torch.stack(
        [Q[:, 2, 1] - Q[:, 1, 2], Q[:, 0, 2] - Q[:, 2, 0], Q[:, 1, 0] - Q[:, 0, 1]], dim=1
    )
    trace = Q.diagonal(dim1=1, dim2=2).sum(dim=1)
    return torch.rad2deg(torch.atan2(axial.norm(dim=1), trace - 1))


def translation_error(
    t_est: Float[Tensor, "n 3"], t_gt: Float[Tensor, "n 3"]
) -> Float[Tensor, "n"]:
    """Distance between the two positions of the object's origin, metres."""
    return nan_is_miss((to_float64(t_est) - to_float64(t_gt)).norm(dim=1))
