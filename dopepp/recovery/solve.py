"""From one instance's keypoints to its pose."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.pnp import PnPResult, solve_pnp
from dopepp.recovery.association import KeypointGroup

SIGMA_FLOOR_PX: Final = 1.0
"""No peak is trusted beyond this: it bounds the weight of a clean peak against a blurred one. On a
trained network's maps 1 px did as well as 2 and better than 0.5."""

WIDENINGS: Final = (1.0, 2.0, 4.0)
"""Factors on the peaks' standard deviations, tried in turn until most keypoints agree."""


def solve_group(
    group: KeypointGroup, cuboid: Float[np.ndarray, "9 3"], K: Float[np.ndarray, "3 3"]
) -> PnPResult:
    """Solve PnP with each keypoint weighted by its own covariance.

    A covariance is averaged over its directions. How wide a network's peak is tells how far it is
    off; its shape does not tell whither: taken at their word, ellipses left ADD-0.1d of a trained
    network at 76 %, circles gave 85 %. Where shapes are right, circles cost 2 points.

    A network's maps are narrower than its errors; where fewer than two thirds of the keypoints
    agree on a pose, the deviations are widened and the pose solved again.

    Args:
        group: The instance's keypoints.
        cuboid: The object's nine keypoints, metres.
        K: Camera matrix of the network's input, pixels.
    """
    covariance = _averaged(group.covariance_px)
    found = int(np.isfinite(group.position[:, 0]).sum())
    best = None
    for widening in WIDENINGS:
        result = solve_pnp(cuboid, group.position, K, covariance_px=covariance * widening**2)
        if best is None or result.inliers.sum() > best.inliers.sum():
            best = result
        if 3 * best.inliers.sum() >= 2 * found:
            break
    assert best is not None
    return best


def _averaged(covariance: Float[np.ndarray, "9 2 2"]) -> Float[np.ndarray, "9 2 2"]:
    """Return circular covariances of the same mean variance, and the floor; NaN stays NaN."""
    variance = covariance.trace(axis1=1, axis2=2) / 2 + SIGMA_FLOOR_PX**2
    return np.asarray(variance[:, None, None] * np.eye(2))
