"""Estimation of a focal length from the perspective of a part of known size.

At twice the focal length and twice the distance, a part appears equally large, but with weaker
perspective: its near and far ends differ less in size. A thin part that faces the camera shows no
perspective, so its focal length cannot be estimated.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult, least_squares

from dopepp.geometry.camera import CameraMatrix, Transform, move_pose, project_keypoints
from dopepp.geometry.cuboid import Cuboid

MIN_POINTS: Final = 8  # With fewer keypoints, an outlier resembles perspective
SOFT: Final = 0.02
"""Keypoint error, as a share of the part's extent in the image, above which the loss is linear."""

LENGTHS: Final = (0.5, 1.0, 2.0)  # Initial factors; each search covers half to twice the factor


class Focal(NamedTuple):
    """Correction of the focal lengths of a camera matrix."""

    factor: float  # Factor on the focal lengths
    deviation: float  # Standard deviation of the factor's logarithm
    # Ratio of robust reprojection costs per degree of freedom, before to after correction.
    gain: float


def focal_factor(
    cuboid: Cuboid, keypoints: Float[np.ndarray, "9 2"], T_cam_obj: Transform, K: CameraMatrix
) -> Focal | None:
    """Fit a focal length, together with the pose, to the detected keypoints of an object.

    Missing ``keypoints`` (pixels) are NaN. ``T_cam_obj``, estimated with K, starts the fit. With
    fewer than eight keypoints, the result is None.
    """
    is_known = np.isfinite(keypoints).all(axis=1)
    if is_known.sum() < MIN_POINTS:
        return None
    extent = float(np.ptp(keypoints[is_known], axis=0).max())

    def errors(values: Float[np.ndarray, "unknowns"], first: float) -> Float[np.ndarray, "errors"]:
        """Return reprojection errors, in extents, for a pose step and log(factor / ``first``)."""
        step, lens, start = values[:6].copy(), K.copy(), T_cam_obj.copy()
        factor = first * math.exp(values[6]) if len(values) > 6 else first
        lens[[0, 1], [0, 1]] *= factor
        start[2, 3] *= factor  # keeps the size in the image
        step[3:] *= start[2, 3]
        projected = project_keypoints(cuboid, move_pose(start, step), lens)[is_known]
        return np.asarray(
            np.nan_to_num((projected - keypoints[is_known]) / extent, nan=10.0).ravel()
        )

    def fit(unknowns: int, first: float) -> OptimizeResult:
        """Fit the pose and, with a seventh unknown, the logarithm of factor / ``first``."""
        most = np.array([*6 * [math.inf], math.log(2)])[:unknowns]
        start, bounds = np.zeros(unknowns), (-most, most)
        return least_squares(
            errors, start, loss="soft_l1", f_scale=SOFT, bounds=bounds, max_nfev=50, args=(first,)
        )

    free = {first: fit(7, first) for first in LENGTHS}
    first = min(free, key=lambda factor: float(free[factor].cost))
    best = free[first]
    spare = 2 * int(is_known.sum()) - 7
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * 2 * best.cost / spare
    gain = (2 * fit(6, 1.0).cost / (spare + 1)) / max(2 * best.cost / spare, 1e-12)
    return Focal(first * math.exp(best.x[6]), math.sqrt(covariance[6, 6]), float(gain))
