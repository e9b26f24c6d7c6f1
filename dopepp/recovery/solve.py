"""From one instance's keypoints to its pose."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.pnp import PnPResult, solve_pnp
from dopepp.recovery.association import KeypointGroup

SIGMA_FLOOR_PX: Final = 0.5
"""No peak is trusted beyond this: it bounds the weight of a clean peak against a blurred one."""

WIDENINGS: Final = (1.0, 2.0, 4.0)
"""Factors on the peaks' standard deviations, tried in turn until most keypoints agree."""


def solve_group(
    group: KeypointGroup,
    cuboid: Float[np.ndarray, "9 3"],
    K: Float[np.ndarray, "3 3"],
    target_sigma_px: float,
) -> PnPResult:
    """Solve PnP with each keypoint's uncertainty read from the width of its peak.

    A network trained with a proper loss returns the target Gaussian blurred by its own uncertainty,
    so variances subtract. A network's maps are narrower than its errors; where fewer than two
    thirds of the keypoints agree on a pose, the deviations are widened and the pose solved again.

    Args:
        group: The instance's keypoints.
        cuboid: The object's nine keypoints, metres.
        K: Camera matrix of the network's input, pixels.
        target_sigma_px: Width of a perfect peak, pixels.
    """
    excess = np.mean(group.spread_px**2, axis=1) - target_sigma_px**2
    sigma = np.sqrt(np.maximum(excess, 0.0) + SIGMA_FLOOR_PX**2)
    found = int(np.isfinite(sigma).sum())
    best = None
    for widening in WIDENINGS:
        result = solve_pnp(cuboid, group.position, K, sigma * widening)
        if best is None or result.inliers.sum() > best.inliers.sum():
            best = result
        if 3 * best.inliers.sum() >= 2 * found:
            break
    assert best is not None
    return best
