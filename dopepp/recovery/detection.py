"""What comes out of recovery: one posed object, with all that a user can check it by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Detection:
    """One object found on an image.

    Attributes:
        object: The part's name.
        score: Mean belief over the nine keypoints (a missing one counts 0), in [0, 1].
        T_cam_obj: Object-to-camera transform, metres, OpenCV camera frame.
        keypoints: The cuboid's corners and centroid projected with this pose, pixels.
        peaks: The measured keypoints, pixels; NaN where the maps had none.
        reprojection_error_px: RMS distance between the two over the PnP inliers, pixels.
    """

    object: str
    score: float
    T_cam_obj: Float[np.ndarray, "4 4"]
    keypoints: Float[np.ndarray, "9 2"]
    peaks: Float[np.ndarray, "9 2"]
    reprojection_error_px: float
