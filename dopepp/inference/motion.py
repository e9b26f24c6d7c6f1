"""How a followed part moves: a Kalman filter over its pose and its velocity.

Each frame's pose comes with a covariance in which the filter's own forecast is contained already
(it was the refinement's prior), so the velocity follows from what the pose has been corrected by:
a pose that is still being corrected is not taken for one that moves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import Step, Transform, moved, step_between

STILL: Final = (math.radians(0.05), 2e-4)
"""Standard deviations of how much the velocity of a part at rest may change in a frame: radians
along each axis, and metres per metre of its distance. The smaller, the less it trembles."""

SUDDEN: Final = (math.radians(4.0), 0.025)
"""The same of a part that a hand takes up or turns round: half of 8° and of 5 % a frame."""

SWERVE: Final = 0.6
"""Share of its speed, and of what the last frame has corrected, that may come on top of it."""

PERSISTENCE: Final = 0.95
"""Share of the velocity that is left after a frame."""

Covariance = Float[np.ndarray, "12 12"]


@dataclass(frozen=True, eq=False)
class Motion:
    """A part's pose and velocity.

    Attributes:
        T_cam_obj: The pose.
        velocity: A frame's turn (rotation vector, radians) about the object's origin, and its shift
            (metres), both in camera axes.
        covariance: Of pose and velocity, in the same six numbers each.
        correction: By which the last frame has moved the forecast.
    """

    T_cam_obj: Transform
    velocity: Step
    covariance: Covariance
    correction: Step

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of the pose alone."""
        return self.covariance[:6, :6]

    def ahead(self, sudden: bool = False) -> Motion:
        """Return the next frame's forecast; ``sudden``: something may have happened."""
        change = self._change(sudden) ** 2
        step = np.eye(12)
        step[:6, 6:] = step[6:, 6:] = PERSISTENCE * np.eye(6)
        added = np.kron([[1.0, 1.0], [1.0, 1.0]], np.diag(change))
        return Motion(
            moved(self.T_cam_obj, PERSISTENCE * self.velocity),
            PERSISTENCE * self.velocity,
            step @ self.covariance @ step.T + added,
            self.correction,
        )

    def seen(self, T_cam_obj: Transform, covariance: Float[np.ndarray, "6 6"]) -> Motion:
        """Return this forecast with a frame's pose, and its covariance, which contains it."""
        correction = step_between(self.T_cam_obj, T_cam_obj)
        pose = self.pose_covariance
        gain = self.covariance[:, :6] @ np.linalg.inv(pose)
        velocity = self.velocity + gain[6:] @ correction
        whole = self.covariance - gain @ (pose - covariance) @ gain.T
        return Motion(T_cam_obj, velocity, whole, correction)

    def _change(self, sudden: bool) -> Step:
        """Return the deviations of the velocity's change."""
        least = SUDDEN if sudden else STILL
        deviations = []
        for number, unit in enumerate((1.0, float(self.T_cam_obj[2, 3]))):
            own = slice(3 * number, 3 * number + 3)
            speeds = np.linalg.norm(self.velocity[own]), np.linalg.norm(self.correction[own])
            deviations.append(max(least[number] * unit, SWERVE / math.sqrt(3) * float(sum(speeds))))
        return np.repeat(deviations, 3)


def at_rest(T_cam_obj: Transform, covariance: Float[np.ndarray, "6 6"]) -> Motion:
    """Return the motion of a part that was seen once: whether it moves is not known."""
    whole = np.zeros((12, 12))
    whole[:6, :6] = covariance
    turn, shift = SUDDEN
    whole[6:, 6:] = np.diag(np.repeat([turn, shift * float(T_cam_obj[2, 3])], 3) ** 2)
    return Motion(T_cam_obj, np.zeros(6), whole, np.zeros(6))
