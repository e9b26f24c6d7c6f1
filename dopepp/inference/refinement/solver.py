"""The one solver of a pose: Gauss–Newton steps on what was known before and on several terms.

To add a kind of evidence, write a :class:`Term`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import Transform, moved, step_between
from dopepp.geometry.refine import solve_damped

PoseMatrix = Float[np.ndarray, "6 6"]
"""Covariance or information of a turn (radians) about the object's origin and a shift (metres)."""

NormalEquations = tuple[PoseMatrix, Float[np.ndarray, "6"]]
"""H and g of H ξ = g, whose ξ is a turn and a shift, both in camera axes."""

DAMPING: Final = 1e-6  # share of each unknown's own information: the prior leaves none of them open
ARRIVED: Final = 0.1  # standard deviations; a shorter step ends the descent

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


class UndecidedError(Exception):
    """Why the evidence does not decide about a pose."""


@dataclass(frozen=True)
class Refinement:
    """What the evidence has made of a pose."""

    T_cam_obj: Transform  # the refined pose
    # Of the refined pose, as PnPResult defines it; None where the given pose was kept
    covariance: PoseMatrix | None = None
    reason: str = ""  # why the given pose was kept; empty where it was refined
    # Share of what the picture tells about the refined outline that agrees with it; None
    # without it
    agreement: float | None = None
    # Share of the refined outline that the picture tells about and that agrees; None without
    # it
    support: float | None = None


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a descent ended: the pose, and the information behind it with the prior's."""

    T_cam_obj: Transform
    information: PoseMatrix


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of a pose (metres) beforehand: a normal distribution around it.

    ``information`` is the inverse of its covariance, of (turn about the object's origin, shift) in
    camera axes, radians and metres.
    """

    T_cam_obj: Transform
    information: PoseMatrix

    def offset(self, T_cam_obj: Transform) -> Float[np.ndarray, "6"]:
        """Return the turn and the shift from a pose to the prior's."""
        return step_between(T_cam_obj, self.T_cam_obj)

    def squared_distance(self, T_cam_obj: Transform) -> float:
        """Return the squared Mahalanobis distance of a pose."""
        offset = self.offset(T_cam_obj)
        return max(0.0, float(offset @ self.information @ offset))

    def draws(self, spread: float, count: int) -> list[Transform]:
        """Draw poses with ``spread`` times the prior's deviations, the same ones every time."""
        deviations = spread * np.linalg.cholesky(np.linalg.inv(self.information))
        draws = np.random.default_rng(0).normal(size=(count, 6))
        return [moved(self.T_cam_obj, deviations @ draw) for draw in draws]


def make_prior(
    T_cam_obj: Transform, diameter: float, covariance: PoseMatrix | None = None
) -> Prior:
    """Return the prior of a pose, with a broad covariance where none, or no finite one, is given.

    The diameter is of the part, metres; the covariance of (turn, shift).
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


class Term(Protocol):
    """Evidence about a pose."""

    def __call__(self, pose: Transform, known: NormalEquations) -> NormalEquations | None:
        """Return the evidence at a pose, linearised; None where there is nothing to read it from.

        ``known`` is what is known of the step besides.
        """


def descend(
    T_cam_obj: Transform, prior: Prior, terms: Sequence[Term], steps: int
) -> Solution | None:
    """Take at most so many Gauss–Newton steps on the terms and the prior, which may be elsewhere.

    None where a term has nothing to read.
    """
    pose, information = T_cam_obj, prior.information
    step = np.empty(6)
    for _ in range(steps):
        known = prior.information, prior.information @ prior.offset(pose)
        information, pull = known
        for term in terms:
            equations = term(pose, known)
            if equations is None:
                return None
            information, pull = information + equations[0], pull + equations[1]
        solve_damped(information, -pull, DAMPING, step)
        pose = moved(pose, step)
        if step @ information @ step < ARRIVED**2:
            break
    return Solution(pose, information)
