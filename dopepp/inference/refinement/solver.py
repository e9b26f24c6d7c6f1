"""Solver of a pose: Gauss–Newton steps on a prior and several measurement terms.

To add a kind of measurement, write a :class:`Term`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import Transform, move_pose, step_between
from dopepp.geometry.refine import solve_damped

PoseMatrix = Float[np.ndarray, "6 6"]
"""Covariance or information (inverse covariance) of a rotation vector about the object's origin
(radians) and a shift (metres)."""

NormalEquations = tuple[PoseMatrix, Float[np.ndarray, "6"]]
"""H and g of H ξ = g, where ξ is rotation vector (radians) and shift (metres), in camera axes."""

DAMPING: Final = 1e-6  # share of each unknown's information; small, as the prior determines all
MIN_STEP: Final = 0.1  # standard deviations; a shorter step ends the descent

# Standard deviations of a pose without covariance: radians, and diameters across and along the
# viewing ray. An image hardly determines the distance.
UNKNOWN_ROTATION: Final = math.radians(8.0)
UNKNOWN_ACROSS: Final = 0.07
UNKNOWN_ALONG: Final = 0.30

# Lower bounds of a prior's standard deviations: radians, and diameters across and along the viewing
# ray. The image does not reveal errors of calibration and CAD file, and an error of the focal
# length causes an error of the distance.
MIN_ROTATION: Final = math.radians(2.0)
MIN_ACROSS: Final = 0.03
MIN_ALONG: Final = 0.15


class UndecidedError(Exception):
    """The measurements do not determine a pose; the message is the reason."""


@dataclass(frozen=True)
class Refinement:
    """Refined pose with its covariance, or the start pose and the reason why it was kept."""

    T_cam_obj: Transform
    covariance: PoseMatrix | None = None  # see PnPResult; None if the start pose was kept
    reason: str = ""  # why the start pose was kept; empty if it was refined
    agreement: float | None = None  # agreeing share of the image's information
    support: float | None = None  # share of the outline with agreeing information


@dataclass(frozen=True, eq=False)
class Solution:
    """Pose and its information (inverse covariance) at the end of a descent."""

    T_cam_obj: Transform
    information: PoseMatrix  # inverse covariance, from the terms and the prior
    # Equations of each term of `descend` at this pose, linearised before the last step
    equations: Sequence[NormalEquations] = ()


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal distribution of a pose, i.e. of the step (rotation vector, shift) from its mean."""

    T_cam_obj: Transform  # mean
    information: PoseMatrix  # inverse of the covariance

    def offset(self, T_cam_obj: Transform) -> Float[np.ndarray, "6"]:
        """Return the step (rotation vector, shift) from a pose to the mean."""
        return step_between(T_cam_obj, self.T_cam_obj)

    def squared_distance(self, T_cam_obj: Transform) -> float:
        """Return the squared Mahalanobis distance of a pose from this distribution."""
        offset = self.offset(T_cam_obj)
        return max(0.0, float(offset @ self.information @ offset))

    def draws(self, spread: float, count: int) -> list[Transform]:
        """Sample poses around the mean; every call returns the same poses.

        Args:
            spread: Factor on the standard deviations of the distribution.
            count: Number of poses.
        """
        deviations = spread * np.linalg.cholesky(np.linalg.inv(self.information))
        draws = np.random.default_rng(0).normal(size=(count, 6))
        return [move_pose(self.T_cam_obj, deviations @ draw) for draw in draws]


def make_prior(
    T_cam_obj: Transform, diameter: float, covariance: PoseMatrix | None = None
) -> Prior:
    """Return the distribution of a pose before refinement: its covariance plus a lower bound.

    Args:
        T_cam_obj: Mean.
        diameter: Diameter of the part, metres.
        covariance: Covariance; if it is None or not finite, a broad covariance is assumed.

    Raises:
        UndecidedError: The pose is not finite.
    """
    if not np.isfinite(T_cam_obj).all():
        raise UndecidedError("the pose is not finite")
    ray = T_cam_obj[:3, 3] / np.linalg.norm(T_cam_obj[:3, 3])
    along = np.outer(ray, ray)
    floor = MIN_ROTATION**2 * np.eye(6)
    floor[3:, 3:] = MIN_ACROSS**2 * (np.eye(3) - along) + MIN_ALONG**2 * along
    floor[3:, 3:] *= diameter**2
    if covariance is None or not np.isfinite(covariance).all():
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = UNKNOWN_ROTATION**2 * np.eye(3)
        shift = UNKNOWN_ACROSS**2 * (np.eye(3) - along) + UNKNOWN_ALONG**2 * along
        covariance[3:, 3:] = diameter**2 * shift
    return Prior(T_cam_obj, np.linalg.inv(np.asarray(covariance, np.float64) + floor))


class Term(Protocol):
    """Term of the cost that :func:`descend` minimises, e.g. from the outline or the depth."""

    def __call__(self, pose: Transform, prior: NormalEquations, /) -> NormalEquations | None:
        """Return the term's normal equations at a pose; None if no measurement is usable.

        ``prior`` is the sum of the equations of the prior and of all other terms. Earlier terms
        were linearised in this iteration, later terms in the previous iteration.
        """


def descend(
    T_cam_obj: Transform, prior: Prior, terms: Sequence[Term], steps: int
) -> Solution | None:
    """Take Gauss–Newton steps on the prior and the terms from a start pose.

    Args:
        T_cam_obj: Start pose, metres.
        prior: Distribution of the pose.
        terms: Measurement terms, added in this order.
        steps: Largest number of steps; steps shorter than :data:`MIN_STEP` end the descent.

    Returns:
        The solution, or None if a term has no usable measurement.
    """
    pose, information = T_cam_obj, prior.information
    step = np.zeros(6)
    last: list[NormalEquations] = []
    for _ in range(steps):
        # Move the equations of the last iteration to the present pose.
        later = [(H, g - H @ step) for H, g in last]
        last, information = [], prior.information
        gradient = information @ prior.offset(pose)
        for term in terms:
            H, g = information, gradient
            for others in (later := later[1:]):
                H, g = H + others[0], g + others[1]
            equations = term(pose, (H, g))
            if equations is None:
                return None
            last.append(equations)
            information, gradient = information + equations[0], gradient + equations[1]
        solve_damped(information, -gradient, DAMPING, step)
        pose = move_pose(pose, step)
        if step @ information @ step < MIN_STEP**2:
            break
    return Solution(pose, information, [(H, g - H @ step) for H, g in last])
