"""From one instance's keypoints to its pose."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.compiled import Array, compiled
from dopepp.geometry.pnp import PnPResult, solve_pnp
from dopepp.recovery.association import KeypointGroup

SIGMA_FLOOR_PX: Final = 0.5
"""No peak is trusted beyond this: it bounds the weight of a clean peak against a blurred one."""

WIDENINGS: Final = (1.0, 2.0, 4.0)
"""Factors on the peaks' standard deviations, tried in turn until most keypoints agree."""


def solve_group(
    group: KeypointGroup, cuboid: Float[np.ndarray, "9 3"], K: Float[np.ndarray, "3 3"]
) -> PnPResult:
    """Solve PnP with each keypoint weighted by its own covariance.

    A network's maps are narrower than its errors; where fewer than two thirds of the keypoints
    agree on a pose, the deviations are widened and the pose solved again.

    Args:
        group: The instance's keypoints.
        cuboid: The object's nine keypoints, metres.
        K: Camera matrix of the network's input, pixels.
    """
    covariance = _floored(group.covariance_px, SIGMA_FLOOR_PX**2)
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


@compiled()
def _floored(covariance: Array, floor: float) -> Array:
    """Raise the variance along either principal axis to the floor; NaN stays NaN.

    Of a symmetric Σ with eigenvalues λ, f(Σ) = αΣ + βI where αλ + β = f(λ) for both of them.
    """
    raised = covariance.copy()
    for k in range(len(covariance)):
        a, b, c = covariance[k, 0, 0], covariance[k, 0, 1], covariance[k, 1, 1]
        middle, radius = (a + c) / 2, math.hypot((a - c) / 2, b)
        low, high = max(middle - radius, floor), max(middle + radius, floor)
        alpha = (high - low) / (2 * radius) if radius > 0.0 else 0.0
        raised[k] *= alpha
        for axis in range(2):
            raised[k, axis, axis] += (high + low) / 2 - alpha * middle
    return raised
