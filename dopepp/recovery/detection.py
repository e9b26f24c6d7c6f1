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
        score: How sure the pose is, in [0, 1]: the mean belief or, once the checkpoint is tuned,
            the probability that ADD is below a tenth of the diameter.
        belief: Mean belief over the nine keypoints, in [0, 1]; one that is missing or does not
            agree with the pose counts 0.
        T_cam_obj: Object-to-camera transform, metres, OpenCV camera frame.
        keypoints: The cuboid's corners and centroid projected with this pose, pixels.
        peaks: The measured keypoints, pixels; NaN where the maps have none that agrees with the
            pose.
        reprojection_error_px: RMS distance between the two over the PnP inliers, pixels.
        covariance: Of a small turn about the object's origin (rotation vector in the camera
            frame, radians) and a small shift (camera frame, metres), from the peaks' covariances.
    """

    object: str
    score: float
    belief: float
    T_cam_obj: Float[np.ndarray, "4 4"]
    keypoints: Float[np.ndarray, "9 2"]
    peaks: Float[np.ndarray, "9 2"]
    reprojection_error_px: float
    covariance: Float[np.ndarray, "6 6"]
