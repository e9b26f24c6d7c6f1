"""One solver for a pose: what the picture says in several terms, and what was known before.

To add a kind of evidence, write an :data:`Evidence`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import Transform, moved
from dopepp.geometry.refine import solve_damped
from dopepp.inference.refinement.fit import Prior, Terms

Evidence = Callable[[Transform, Terms], Terms | None]
"""Terms at a pose, given what is known of the step besides; None where there is nothing to say them
from."""

DAMPING: Final = 1e-6
"""Share of each unknown's own information: the prior leaves none of them open."""

ARRIVED: Final = 0.1
"""Standard deviations; a shorter step ends the descent."""


class UndecidedError(Exception):
    """Why the evidence does not decide about a pose."""


@dataclass(frozen=True)
class Refinement:
    """What the evidence has made of a pose.

    Attributes:
        T_cam_obj: The refined pose.
        covariance: Of the refined pose, as :class:`~dopepp.geometry.pnp.PnPResult` defines it; None
            where the given pose was kept.
        reason: Why the given pose was kept; empty where it was refined.
        agreement: Share of what the picture tells about the refined outline that agrees with it;
            None without it.
        support: Share of the refined outline that the picture tells about and that agrees; None
            without it.
    """

    T_cam_obj: Transform
    covariance: Float[np.ndarray, "6 6"] | None = None
    reason: str = ""
    agreement: float | None = None
    support: float | None = None


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a descent ended.

    Attributes:
        T_cam_obj: The pose.
        information: Behind it, the prior's included.
    """

    T_cam_obj: Transform
    information: Float[np.ndarray, "6 6"]


def descend(
    T_cam_obj: Transform, prior: Prior, evidence: Sequence[Evidence], steps: int
) -> Solution | None:
    """Take Gauss–Newton steps on the evidence and the prior; None where evidence is missing.

    Args:
        T_cam_obj: Where to start.
        prior: What was known; it may be elsewhere.
        evidence: The terms.
        steps: How many at most.
    """
    pose, information = T_cam_obj, prior.information
    step = np.empty(6)
    for _ in range(steps):
        known = prior.information, prior.information @ prior.offset(pose)
        information, pull = known
        for term in evidence:
            terms = term(pose, known)
            if terms is None:
                return None
            information, pull = information + terms[0], pull + terms[1]
        solve_damped(information, -pull, DAMPING, step)
        pose = moved(pose, step)
        if step @ information @ step < ARRIVED**2:
            break
    return Solution(pose, information)
