"""Where else a part may be: poses to start from where the picture does not agree with a given one.

What hides a part, or looks like it, puts several keypoints wrong together, which no keypoint's own
covariance tells; the others are right. So every four keypoints give a pose. Besides, poses are
drawn around the given one.
"""

from __future__ import annotations

from itertools import combinations
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import CameraMatrix, Transform, make_transform, moved
from dopepp.geometry.cuboid import Cuboid
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.refinement.fit import Prior

FEW: Final = 4
"""Keypoints that fix a pose."""

NUM_QUADRUPLES: Final = 40
"""Of the 126 of nine keypoints."""

NUM_DRAWS: Final = 4


def poses_of_four(
    cuboid: Cuboid, peaks: Float[np.ndarray, "9 2"], K: CameraMatrix
) -> list[Transform]:
    """Return the poses of several quadruples of measured keypoints, always the same ones.

    Args:
        cuboid: The part's keypoints, metres.
        peaks: Those measured on the picture, pixels; NaN where there is none.
        K: Camera matrix.
    """
    quadruples = list(combinations(np.flatnonzero(np.isfinite(peaks).all(axis=1)), FEW))
    order = np.random.default_rng(0).permutation(len(quadruples))[:NUM_QUADRUPLES]
    poses = []
    for number in order:
        few = list(quadruples[number])
        try:
            found, turn, place = cv2.solvePnP(
                cuboid[few], peaks[few], K, None, flags=cv2.SOLVEPNP_SQPNP
            )
        except cv2.error:  # all four in one place
            continue
        if found and np.isfinite(turn).all() and place[2, 0] > 0:
            poses.append(make_transform(rotation_vector_to_matrix(turn[:, 0]), place[:, 0]))
    return poses


def drawn_poses(prior: Prior, spread: float) -> list[Transform]:
    """Return draws from a prior of so many times its deviations, always the same ones."""
    deviations = spread * np.linalg.cholesky(np.linalg.inv(prior.information))
    draws = np.random.default_rng(0).normal(size=(NUM_DRAWS, 6))
    return [moved(prior.T_cam_obj, deviations @ draw) for draw in draws]
