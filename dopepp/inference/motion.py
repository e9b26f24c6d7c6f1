"""Kalman filter over pose and velocity of a tracked part, in the camera frame or in the world.

The covariance of each frame's pose already contains the filter's prediction, because the prediction
was the refinement's prior. The velocity is therefore updated by the correction of the pose, and a
converging pose does not appear as motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import Step, Transform, move_pose, step_between

# Standard deviations of the change in velocity per frame, radians about each axis and metres per
# metre of distance: of a part at rest (smaller values reduce jitter), and of a part that a hand
# moves by up to 8° and 5 % of the distance per frame (two standard deviations).
STILL: Final = (math.radians(0.05), 2e-4)
SUDDEN: Final = (math.radians(4.0), 0.025)
SWERVE: Final = 0.6  # further standard deviation of this change, share of speed + last correction
PERSISTENCE: Final = 0.95  # share of the velocity that remains after a frame


@dataclass(frozen=True, eq=False)
class Motion:
    """State of the Kalman filter: pose and velocity of a part."""

    T_cam_obj: Transform  # T_world_obj, if the part is tracked in the world
    # Rotation per frame (rotation vector about the object's origin, radians) and shift (metres),
    # both in the axes of this frame
    velocity: Step
    covariance: Float[np.ndarray, "12 12"]  # joint covariance of pose and velocity
    correction: Step  # step from the predicted pose to the updated pose

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of the pose alone."""
        return self.covariance[:6, :6]

    def predict(self, distance: float, sudden: bool = False) -> Motion:
        """Predict the motion on the next frame of a part at a distance (metres) from the camera.

        ``sudden`` permits a large change in velocity.
        """
        step = np.eye(12)
        step[:6, 6:] = step[6:, 6:] = PERSISTENCE * np.eye(6)
        change = self._velocity_change(distance, sudden)
        covariance = step @ self.covariance @ step.T + np.kron(np.ones((2, 2)), np.diag(change**2))
        velocity = PERSISTENCE * self.velocity
        return Motion(move_pose(self.T_cam_obj, velocity), velocity, covariance, self.correction)

    def update(self, T_cam_obj: Transform, covariance: Float[np.ndarray, "6 6"]) -> Motion:
        """Update a prediction by a pose whose covariance already contains the prediction."""
        correction = step_between(self.T_cam_obj, T_cam_obj)
        predicted = self.pose_covariance
        gain = self.covariance[:, :6] @ np.linalg.inv(predicted)
        velocity = self.velocity + gain[6:] @ correction
        updated = self.covariance - gain @ (predicted - covariance) @ gain.T
        return Motion(T_cam_obj, velocity, updated, correction)

    def _velocity_change(self, distance: float, sudden: bool) -> Step:
        """Return the standard deviations of the velocity's change per frame, radians and metres."""
        least = SUDDEN if sudden else STILL
        deviations = []
        for number, unit in enumerate((1.0, distance)):
            axes = slice(3 * number, 3 * number + 3)
            speeds = np.linalg.norm(self.velocity[axes]), np.linalg.norm(self.correction[axes])
            deviations.append(max(least[number] * unit, SWERVE / math.sqrt(3) * float(sum(speeds))))
        return np.repeat(deviations, 3)


def at_rest(T_cam_obj: Transform, covariance: Float[np.ndarray, "6 6"], distance: float) -> Motion:
    """Return the motion of a part after its first frame: at rest, with an uncertain velocity."""
    both = np.zeros((12, 12))
    both[:6, :6] = covariance
    rotation, shift = SUDDEN
    both[6:, 6:] = np.diag(np.repeat([rotation, shift * distance], 3) ** 2)
    return Motion(T_cam_obj, np.zeros(6), both, np.zeros(6))
