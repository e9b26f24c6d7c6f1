"""What the RGB image says about a pose, as a Gaussian around the pose it gave."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

UNKNOWN_TURN: Final = math.radians(8.0)
UNKNOWN_ACROSS: Final = 0.07
UNKNOWN_ALONG: Final = 0.30
"""Standard deviations of a pose without covariance: radians, and diameters across and along the
viewing ray. An image says little about the distance."""

LEAST_TURN: Final = math.radians(2.0)
LEAST_ACROSS: Final = 0.03
LEAST_ALONG: Final = 0.15
"""Never less, in radians and diameters: calibration and CAD have errors that no image shows, and an
error of the focal length is one of the distance."""

FARTHEST: Final = 3.0
"""Standard deviations (Mahalanobis distance, with the least deviations above) beyond which depth
contradicts the image."""


@dataclass(frozen=True, eq=False)
class Prior:
    """A pose and the inverse of its covariance.

    Attributes:
        T_cam_obj: The pose, metres.
        information: Of (turn about the object's origin, shift), camera axes, radians and metres.
    """

    T_cam_obj: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]

    def offset(self, T_cam_obj: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
        """Return the turn and the shift from a pose to the prior's."""
        # OpenCV's Rodrigues rounds turns below 1e-5 to none.
        turn = Rotation.from_matrix(self.T_cam_obj[:3, :3] @ T_cam_obj[:3, :3].T).as_rotvec()
        return np.concatenate([turn, self.T_cam_obj[:3, 3] - T_cam_obj[:3, 3]])

    def doubt(self, T_cam_obj: Float[np.ndarray, "4 4"]) -> str:
        """Say why a pose contradicts the image; empty where it does not."""
        offset = self.offset(T_cam_obj)
        distance = math.sqrt(max(0.0, float(offset @ self.information @ offset)))
        if distance <= FARTHEST:
            return ""
        return f"{distance:.1f} standard deviations from the image's pose, more than {FARTHEST:g}"


def make_prior(
    T_cam_obj: Float[np.ndarray, "4 4"],
    diameter: float,
    covariance: Float[np.ndarray, "6 6"] | None = None,
) -> Prior:
    """Return the prior of a pose, with a broad covariance where none is given.

    Args:
        T_cam_obj: The pose.
        diameter: Of the part, metres.
        covariance: Of (turn, shift); one that is not finite counts as none.
    """
    ray = T_cam_obj[:3, 3] / np.linalg.norm(T_cam_obj[:3, 3])
    along = np.outer(ray, ray)
    floor = LEAST_TURN**2 * np.eye(6)
    floor[3:, 3:] = LEAST_ACROSS**2 * (np.eye(3) - along) + LEAST_ALONG**2 * along
    floor[3:, 3:] *= diameter**2
    if covariance is None or not np.isfinite(covariance).all():
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = UNKNOWN_TURN**2 * np.eye(3)
        shift = UNKNOWN_ACROSS**2 * (np.eye(3) - along) + UNKNOWN_ALONG**2 * along
        covariance[3:, 3:] = diameter**2 * shift
    return Prior(T_cam_obj, np.linalg.inv(np.asarray(covariance, np.float64) + floor))
