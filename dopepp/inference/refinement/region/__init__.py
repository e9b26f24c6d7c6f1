"""Poses refined on the picture alone: the outline is moved to where the part's colours end.

Colours inside a part's outline and around it are learned at the pose that is to be refined. Along
the normals of the outline they and the picture's edges tell where the part ends
(:mod:`~dopepp.inference.refinement.region.shifts`), and a few Gauss–Newton steps follow, from
coarse to fine, with the given pose and its covariance as prior. Where the picture does not agree
with what that leads to, the descent starts from elsewhere too, with a prior that lets go, and the
end that the picture agrees with best is taken. That is for poses whose covariance may be wrong, as
a network's of a part that is hidden. Where the picture does not decide, the given pose is kept.

Errors of neighbouring points are alike, and an offset may be common to all: a covariance that took
them for independent would let a blurred edge overrule the network's distance. The idea of regions
is that of PWP3D and RBOT, that of probabilistic lines SRT3D's (Stoiber et al. 2022).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.inference.refinement.colour import EDGE_PX, crop_around
from dopepp.inference.refinement.depth import DepthEvidence
from dopepp.inference.refinement.outline import make_outline_mesh, outline_rows, posed
from dopepp.inference.refinement.region.round import Agreement, Round, Stage
from dopepp.inference.refinement.region.shifts import FOLLOWED, FOUND, Weights
from dopepp.inference.refinement.solver import (
    PoseMatrix,
    Prior,
    Refinement,
    Solution,
    Term,
    UndecidedError,
    make_prior,
)
from dopepp.parts.mesh import Faces, Vertices, largest_distance

COARSE: Final = Stage(120, reach=1.0, steps=3, points=100, tiles=1)
MIDDLE: Final = Stage(200, reach=0.5, steps=2, points=120, tiles=2)
FINE: Final = Stage(300, reach=0.25, steps=3, points=160, tiles=3)
"""The coarse round is every start's, the others only the best one's."""

WIDENED: Final = 2.0
"""Factor on the prior's deviations in the coarse round: a start that is far off shows a picture
that agrees with itself too little to overrule the prior, until it has come nearer."""

SURE: Final = 0.85
"""Share of what the picture tells of the outline that agrees, below which it is looked for farther
away, and from which it is believed there."""

SUPPORTED: Final = 0.35
MORE: Final = 0.02
"""Share of the whole outline that must agree there, and by how much more than where it began."""

FAR: Final = 3.0
"""Deviations there, besides the given pose's own: so many times those of a pose that nothing is
known about."""

NUM_DRAWS: Final = 4
NUM_STARTS: Final = 4
"""Poses that are drawn there, and the likeliest starts that are tried besides the given pose."""

CERTAIN: Final = 0.95  # share of what the picture tells that ends the search

REACH: Final = (2.5, 0.15)
"""Standard deviations of the outline under the prior; not above such a share of its extent."""

ENOUGH: Final = 0.6
"""Of the first reach, which is then one and a half standard deviations: a round that looks as far
needs none before it."""

Starts = Callable[[], Sequence[Transform]]
"""Where else a part may be; called where that is asked for."""

Found = tuple[Solution, Agreement]  # where a descent ended, and how well the outline agrees there


class RegionRefiner:
    """Refines the poses of one part.

    Args:
        vertices: Positions, metres.
        faces: Triangles. Many are replaced by fewer.

    Raises:
        ValueError: The triangles have no area.
    """

    def __init__(self, vertices: Vertices, faces: Faces) -> None:
        self._mesh = make_outline_mesh(vertices, faces)
        self._diameter = largest_distance(self._mesh.vertices)

    def refine(
        self,
        image: Picture,
        K: CameraMatrix,
        T_cam_obj: Transform,
        covariance: PoseMatrix | None = None,
        followed: bool = False,
        starts: Starts | None = None,
    ) -> Refinement:
        """Refine one pose; see :meth:`~dopepp.inference.refinement.refiner.PartRefiner.refine`.

        ``starts`` is asked for further poses where the picture does not agree with what is near the
        given one: then those, and some that are drawn, are started from too. None: the covariance
        is believed.
        """
        given = np.asarray(T_cam_obj, np.float64)
        if not np.isfinite(given).all():
            return Refinement(given, reason="the pose is not finite")
        try:
            prior = _prior(given, self._diameter, covariance)
            loose = _loosened(prior, self._diameter)
            rounds = self._rounds(image, K, given, FOLLOWED if followed else FOUND)
            return refinement(*_search(rounds, prior, loose, starts))
        except UndecidedError as undecided:
            return Refinement(given, reason=str(undecided))

    def refine_with(
        self, image: Picture, K: CameraMatrix, depth: DepthEvidence, start: Solution
    ) -> Found:
        """Refine on the picture and with depth at once, from where one of them alone has led.

        Raises:
            UndecidedError: The picture does not decide.
        """
        seen = depth.seen(start.T_cam_obj)
        rounds = self._rounds(image, K, start.T_cam_obj, more=[depth.term(seen)])
        reach = _first_reach(rounds[0], Prior(start.T_cam_obj, start.information))
        end = _descended(_needed(rounds, reach), start.T_cam_obj, depth.prior, reach)
        known = depth.information(end.T_cam_obj, seen)
        return end, rounds[-1].believed(end, depth.prior, reach, known)

    def _rounds(
        self,
        image: Picture,
        K: CameraMatrix,
        pose: Transform,
        weights: Weights = FOUND,
        more: Sequence[Term] = (),
    ) -> list[Round]:
        """Return the rounds around a pose; an :class:`UndecidedError` where it is not in view."""
        K = np.asarray(K, np.float64)
        at = posed(self._mesh, pose, K)
        if at is None:
            raise UndecidedError("the part reaches behind the camera")
        corners = np.stack([at.pixels.min(axis=0), at.pixels.max(axis=0)])
        rounds = []
        for stage in (COARSE, MIDDLE, FINE):
            crop = crop_around(image, K, corners, stage.longest_px)
            if isinstance(crop, str):
                raise UndecidedError(crop)
            rounds.append(Round(self._mesh, crop, stage, weights, more))
        return rounds


def refinement(end: Solution, agreement: Agreement) -> Refinement:
    """Return what a descent has made of a pose."""
    covariance = np.linalg.inv(end.information)
    return Refinement(end.T_cam_obj, covariance, "", agreement.share, agreement.support)


def _prior(given: Transform, diameter: float, covariance: PoseMatrix | None) -> Prior:
    """Return the given pose with its covariance as it is, or with a broad one."""
    if covariance is None or not np.isfinite(covariance).all():
        return make_prior(given, diameter)
    # A thousandth of a degree and of a millimetre keep it from being singular.
    floor = np.diag(np.repeat([1e-5**2, 1e-6**2], 3))
    return Prior(given, np.linalg.inv(np.asarray(covariance, np.float64) + floor))


def _loosened(prior: Prior, diameter: float) -> Prior:
    """Return a weaker prior (larger covariance) at the same pose."""
    broad = make_prior(prior.T_cam_obj, diameter).information
    covariance = np.linalg.inv(prior.information) + FAR**2 * np.linalg.inv(broad)
    return Prior(prior.T_cam_obj, np.linalg.inv(covariance))


def _search(rounds: Sequence[Round], prior: Prior, loose: Prior, starts: Starts | None) -> Found:
    """Descend from the given pose and, where that is doubtful, from farther away.

    Raises:
        UndecidedError: No descent is to be believed.
    """
    near, doubt = None, None
    try:
        near = _near(rounds, prior)
    except UndecidedError as undecided:
        doubt = undecided
    if starts is not None and (near is None or near[1].share < SURE):
        near = _far(rounds, prior, loose, starts(), near) or near
    if near is None:
        assert doubt is not None
        raise doubt
    return near


def _near(rounds: Sequence[Round], prior: Prior) -> Found:
    """Descend from the given pose; see :func:`_search`."""
    given = prior.T_cam_obj
    reach = _first_reach(rounds[0], prior)
    rounds = _needed(rounds, reach)
    if rounds[0] is rounds[-1]:  # the last one alone
        return _refined(rounds, given, prior, reach)
    return _from_afar(rounds, given, prior, reach)


def _far(
    rounds: Sequence[Round],
    prior: Prior,
    loose: Prior,
    starts: Sequence[Transform],
    near: Found | None,
) -> Found | None:
    """Descend from the likeliest starts; return the end that agrees best.

    None where none agrees well, or with no more of the outline than ``near`` or the given pose.
    """
    best: Found | None = None
    with contextlib.suppress(UndecidedError):
        reach = _first_reach(rounds[0], loose)
        if near is None:
            rounds[-1].learn(prior.T_cam_obj, reach)
        before = rounds[-1].agreement(prior.T_cam_obj, reach) if near is None else near[1]
        supported = max(SUPPORTED, before.support + MORE)
        rounds[0].learn(prior.T_cam_obj, reach)
        others = [*starts, *loose.draws(1 / FAR, NUM_DRAWS)]
        others.sort(key=lambda start: -rounds[0].log_likelihood(start, loose))
        for start in (prior.T_cam_obj, *others[:NUM_STARTS]):
            with contextlib.suppress(UndecidedError):
                end, _ = _from_afar(rounds, start, loose, reach)
                # A prior that admits where that led, and holds the pose no less than it must.
                surprise = max(1.0, prior.squared_distance(end.T_cam_obj) / 6)
                admitting = Prior(prior.T_cam_obj, prior.information / surprise)
                found = _refined(rounds[-1:], end.T_cam_obj, admitting, reach)
                least = SURE if best is None else best[1].share
                if found[1].share >= least and found[1].support >= supported:
                    best = found
            if best is not None and best[1].share >= CERTAIN:
                break
    return best


def _from_afar(rounds: Sequence[Round], start: Transform, prior: Prior, reach: float) -> Found:
    """Descend in all rounds, in the first one with a prior that lets go."""
    rounds[0].learn(start, reach)
    wide = Prior(prior.T_cam_obj, prior.information / WIDENED**2)
    return _refined(rounds[1:], rounds[0].descend(start, wide, reach).T_cam_obj, prior, reach)


def _needed(rounds: Sequence[Round], reach: float) -> Sequence[Round]:
    """Leave out rounds that look farther than the reach: a tracked part needs the last one only."""
    while len(rounds) > 1 and rounds[1].farthest(reach) >= ENOUGH * reach:
        rounds = rounds[1:]
    if len(rounds) == 1 and rounds[0].farthest(reach) < reach:
        # From where the first time led, the colours are learned better.
        return [*rounds, *rounds]
    return rounds


def _refined(rounds: Sequence[Round], start: Transform, prior: Prior, reach: float) -> Found:
    """Descend in one round after the other, and see whether to believe where that leads.

    Raises:
        UndecidedError: Not to be believed.
    """
    end = _descended(rounds, start, prior, reach)
    return end, rounds[-1].believed(end, prior, reach, prior.information)


def _descended(rounds: Sequence[Round], start: Transform, prior: Prior, reach: float) -> Solution:
    """Descend in one round after the other."""
    end = Solution(start, prior.information)
    for one in rounds:
        one.learn(end.T_cam_obj, reach)
        end = one.descend(end.T_cam_obj, prior, reach)
    return end


def _first_reach(coarse: Round, prior: Prior) -> float:
    """Return how far the outline may be off, pixels of the picture."""
    contour = coarse.contour(prior.T_cam_obj)
    if contour is None:
        raise UndecidedError("too little of the part's outline is on the picture")
    crop = coarse.crop
    rows = outline_rows(contour, prior.T_cam_obj, crop.K)
    covariance = np.linalg.inv(prior.information)
    deviation = math.sqrt(float(np.mean(((rows @ covariance) * rows).sum(axis=1))))
    factor, most = REACH
    return max(EDGE_PX, min(factor * deviation, most * crop.extent) / crop.scale)
