"""Refinement on the image: move the outline to the border between part and background colours.

1. Histograms of the colours inside the outline and around it are computed at the start pose
   ("learned").
2. Colours and edges along the normals of the outline show where the part ends
   (:mod:`~dopepp.inference.refinement.region.shifts`).
3. A few Gauss–Newton steps follow, in rounds from coarse to fine, with the start pose and its
   covariance as prior. The last round is repeated until it converges.
4. If less than ``MIN_AGREEMENT`` of the outline agrees with the image, the descent is repeated from
   other start poses with a weaker prior, and the result that agrees best is returned. This corrects
   poses whose covariance is too small, for instance because the part is occluded.
5. If the image does not determine the pose, the start pose is kept.

Errors of neighbouring points are correlated, and all points share errors of offset and scale
(:mod:`~dopepp.inference.refinement.region.shared_errors`). With independent errors, a blurred edge
or a size error of a percent would outweigh the network's distance. Regions are used as in PWP3D and
RBOT, and probabilistic lines as in SRT3D (Stoiber et al. 2022).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.inference.refinement.colour import EDGE_PX, crop_around
from dopepp.inference.refinement.depth import DepthEvidence
from dopepp.inference.refinement.outline import make_outline_mesh, outline_rows, posed
from dopepp.inference.refinement.region.round import OutlineAgreement, RegionStage, Round
from dopepp.inference.refinement.region.shared_errors import SCALE_ERROR
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

COARSE: Final = RegionStage(120, reach=1.0, steps=3, points=100, tiles=1)
MIDDLE: Final = RegionStage(200, reach=0.5, steps=2, points=120, tiles=2)
FINE: Final = RegionStage(300, reach=0.25, steps=3, points=160, tiles=3)
"""In the extended search, the coarse stage is run from every start, the others only from the best
results."""

STAGES: Final = (COARSE, MIDDLE, FINE)

WIDENED: Final = 2.0
"""Factor on the prior's deviations in the coarse round. Far from the correct pose, the points of
the outline contradict each other, so the image has too little weight against the prior."""

MIN_AGREEMENT: Final = 0.85
"""Agreement below which the search is extended, and smallest agreement of an accepted pose."""

# Support that the extended search requires of a pose, and its smallest gain over the first pose.
MIN_SUPPORT: Final = 0.35
MIN_SUPPORT_GAIN: Final = 0.02

SPREAD: Final = 3.0
"""Additional standard deviations of the extended search, as multiples of those of a pose without
covariance."""

NUM_DRAWS: Final = 4  # poses that are sampled from the weaker prior in the extended search
NUM_STARTS: Final = 4  # most likely starts that are tried besides the start pose
NUM_CONTINUED: Final = 2  # coarse results that the other stages continue

CERTAIN: Final = 0.95  # agreement that ends the search

REACH: Final = (2.5, 0.15)
"""Search distance in standard deviations of the outline under the prior, and its upper bound as a
share of the outline's extent."""

MIN_COVERED: Final = 0.6
"""A round is unnecessary if the next round covers this share of the search distance, which is 1.5
standard deviations."""

MAX_REPEATS: Final = 3  # repetitions of the last round, until it converges
CONVERGED: Final = 0.4  # standard deviations that a converged round moves the pose at most

Starts = Callable[[], Sequence[Transform]]
"""Returns further start poses; called only if the search is extended."""

Outcome = tuple[Solution, OutlineAgreement]  # solution of a descent, and agreement of its outline


class RegionRefiner:
    """Refines the poses of one part.

    Args:
        vertices: Positions, metres.
        faces: Triangles; large meshes are simplified.
        scale_error: Largest relative error of the part's size or of the focal length.

    Raises:
        ValueError: The triangles have no area.
    """

    def __init__(self, vertices: Vertices, faces: Faces, scale_error: float = SCALE_ERROR) -> None:
        self._scale_error = scale_error
        self.mesh = make_outline_mesh(vertices, faces)
        self.diameter = largest_distance(self.mesh.vertices)

    def refine(
        self,
        image: RGBImage,
        K: CameraMatrix,
        T_cam_obj: Transform,
        covariance: PoseMatrix | None = None,
        followed: bool = False,
        starts: Starts | None = None,
    ) -> Refinement:
        """Refine one pose on the image.

        If the image does not agree with poses near ``T_cam_obj``, the search is extended to the
        poses that ``starts`` returns and to poses sampled from a weaker prior. Without ``starts``,
        the search is not extended. The other arguments and the result are those of
        :meth:`~dopepp.inference.refinement.refiner.PartRefiner.refine`.
        """
        given = np.asarray(T_cam_obj, np.float64)
        try:
            broad = make_prior(given, self.diameter)
            prior = broad
            if covariance is not None and np.isfinite(covariance).all():
                # A thousandth of a degree and of a millimetre avoid a singular matrix.
                floor = np.diag(np.repeat([1e-5**2, 1e-6**2], 3))
                prior = Prior(given, np.linalg.inv(np.asarray(covariance, np.float64) + floor))
            # A weaker prior (larger covariance) at the same pose.
            weak = np.linalg.inv(prior.information) + SPREAD**2 * np.linalg.inv(broad.information)
            wide_prior = Prior(given, np.linalg.inv(weak))
            rounds = self.rounds(image, K, given, FOLLOWED if followed else FOUND)
            return refinement(*_search(rounds, prior, wide_prior, starts))
        except UndecidedError as undecided:
            return Refinement(given, reason=str(undecided))

    def coarse_fit(
        self, image: RGBImage, K: CameraMatrix, T_cam_obj: Transform, covariance: PoseMatrix
    ) -> float:
        """Return how well the outline fits after the coarse round, to compare many start poses.

        Args:
            image: RGB.
            K: Camera matrix, pixels.
            T_cam_obj: Start pose, metres.
            covariance: Covariance of the start pose, positive definite.

        Returns:
            ``share`` of :class:`OutlineAgreement`; 0 if the image shows too little of the outline.
        """
        prior = Prior(T_cam_obj, np.linalg.inv(covariance))
        try:
            (coarse,) = self.rounds(image, K, T_cam_obj, stages=[COARSE])
            reach = search_distance(coarse, prior)
            end = Descent([coarse], prior, reach).coarse_end(T_cam_obj)
            coarse.learn(end, reach)
            return coarse.agreement(end, reach).share
        except UndecidedError:
            return 0.0

    def refine_with(
        self, image: RGBImage, K: CameraMatrix, depth: DepthEvidence, start: Solution
    ) -> Outcome:
        """Refine on image and depth together.

        Args:
            image: RGB.
            K: Camera matrix, pixels.
            depth: Measured depth of the part, with the prior of the pose.
            start: Solution of the refinement on the image or on depth alone.

        Returns:
            The solution, and the agreement of its outline with the image.

        Raises:
            UndecidedError: The image does not determine the pose, or contradicts the result.
        """
        visible = depth.visible(start.T_cam_obj)
        rounds = self.rounds(image, K, start.T_cam_obj, further_terms=[depth.term(visible)])
        reach = search_distance(rounds[0], Prior(start.T_cam_obj, start.information))
        # Depth gets more weight as its residuals shrink, so the descent needs all rounds.
        end = Descent(rounds, depth.prior, reach).run(start.T_cam_obj)
        information = depth.information(end.T_cam_obj, visible)
        return end, rounds[-1].check(end, depth.prior, reach, information)

    def rounds(
        self,
        image: RGBImage,
        K: CameraMatrix,
        pose: Transform,
        weights: Weights = FOUND,
        further_terms: Sequence[Term] = (),
        stages: Sequence[RegionStage] = STAGES,
    ) -> list[Round]:
        """Return one round of optimisation per stage, each with its own crop around a pose.

        Args:
            image: RGB.
            K: Camera matrix, pixels.
            pose: Pose T_cam_obj at which the part is cut out, metres.
            weights: Weights of colours and edges.
            further_terms: Solver terms in addition to the outline, e.g. depth.
            stages: Resolutions and search distances, from coarse to fine.

        Raises:
            UndecidedError: The part is too small, outside the image or behind the camera.
        """
        K = np.asarray(K, np.float64)
        posed_mesh = posed(self.mesh, pose, K)
        if posed_mesh is None:
            raise UndecidedError("the part reaches behind the camera")
        corners = np.stack([posed_mesh.pixels.min(axis=0), posed_mesh.pixels.max(axis=0)])
        crops = [crop_around(image, K, corners, stage.longest_px) for stage in stages]
        return [
            Round(self.mesh, crop, stage, weights, further_terms, self._scale_error)
            for crop, stage in zip(crops, stages, strict=True)
        ]


def refinement(end: Solution, agreement: OutlineAgreement) -> Refinement:
    """Return the result of a descent as a :class:`Refinement`."""
    covariance = np.linalg.inv(end.information)
    return Refinement(end.T_cam_obj, covariance, "", agreement.share, agreement.support)


@dataclass(frozen=True, eq=False)
class Descent:
    """Descent in rounds of refinement, under a prior and within a search distance."""

    rounds: Sequence[Round]  # rounds of optimisation, from coarse to fine
    prior: Prior  # distribution of the pose before the refinement
    reach: float  # search distance, pixels of the image

    def run(self, start: Transform) -> Solution:
        """Descend from a start pose in all rounds, from coarse to fine."""
        end = Solution(start, self.prior.information)
        for stage in self.rounds:
            stage.learn(end.T_cam_obj, self.reach)
            end = stage.descend(end.T_cam_obj, self.prior, self.reach)
        return end

    def coarse_end(self, start: Transform) -> Transform:
        """Return the pose after the first round; the prior's deviations are widened by WIDENED."""
        weaker = Prior(self.prior.T_cam_obj, self.prior.information / WIDENED**2)
        return replace(self, rounds=self.rounds[:1], prior=weaker).run(start).T_cam_obj

    def refine(self, start: Transform) -> Outcome:
        """Descend, repeat the last round until it converges, and check the result.

        Raises:
            UndecidedError: :meth:`Round.check` rejects the result.
        """
        end, last = self.run(start), self.rounds[-1]
        # Each repetition learns the colours at a better pose, within the smallest search distance.
        repetition = Descent([last], self.prior, EDGE_PX)
        for _ in range(MAX_REPEATS if self.reach > EDGE_PX else 0):
            before = end.T_cam_obj
            end = repetition.run(before)
            if has_converged(end, before):
                break
        return end, last.check(end, self.prior, self.reach, self.prior.information)


def _search(
    rounds: Sequence[Round], prior: Prior, wide_prior: Prior, starts: Starts | None
) -> Outcome:
    """Descend from the prior's pose; below ``MIN_AGREEMENT``, or without a result, from others too.

    Args:
        rounds: Rounds of optimisation, from coarse to fine.
        prior: Distribution of the pose before the refinement.
        wide_prior: The same pose with larger standard deviations, for the wider search.
        starts: Returns further start poses; None for no wider search.

    Raises:
        UndecidedError: No descent is accepted.
    """
    outcome, failure = None, None
    try:
        search_px = search_distance(rounds[0], prior)
        descent = Descent(necessary_rounds(rounds, search_px), prior, search_px)
        start = prior.T_cam_obj
        if descent.rounds[0] is not descent.rounds[-1]:  # the last round may be the only one
            start = descent.coarse_end(start)
            descent = replace(descent, rounds=descent.rounds[1:])
        outcome = descent.refine(start)
    except UndecidedError as undecided:
        failure = undecided
    if starts is not None and (outcome is None or outcome[1].share < MIN_AGREEMENT):
        outcome = _search_far(rounds, prior, wide_prior, starts(), outcome) or outcome
    if outcome is None:
        assert failure is not None
        raise failure
    return outcome


def _search_far(
    rounds: Sequence[Round],
    prior: Prior,
    wide_prior: Prior,
    starts: Sequence[Transform],
    nearby: Outcome | None,
) -> Outcome | None:
    """Descend from the most likely start poses; return the result that agrees best with the image.

    Args:
        rounds: Rounds of optimisation, from coarse to fine.
        prior: Distribution of the pose before the refinement.
        wide_prior: The same pose with larger standard deviations.
        starts: Further start poses; random poses from the wide prior are added.
        nearby: Result of the search near the prior's pose, if any.

    Returns:
        The result, or None if no result agrees well and has more support than ``nearby`` (without
        ``nearby``: than the prior's pose).
    """
    best: Outcome | None = None
    given, first, last = prior.T_cam_obj, rounds[0], rounds[-1]
    with contextlib.suppress(UndecidedError):
        search_px = search_distance(first, wide_prior)
        if nearby is None:
            last.learn(given, search_px)
        former_agreement = last.agreement(given, search_px) if nearby is None else nearby[1]
        least_support = max(MIN_SUPPORT, former_agreement.support + MIN_SUPPORT_GAIN)
        first.learn(given, search_px)
        descent = Descent(rounds, wide_prior, search_px)
        further_starts = [*starts, *wide_prior.draws(1 / SPREAD, NUM_DRAWS)]
        further_starts.sort(key=lambda start: -first.log_likelihood(start, wide_prior))
        coarse_ends = []
        for start in (given, *further_starts[:NUM_STARTS]):
            with contextlib.suppress(UndecidedError):
                coarse_ends.append(descent.coarse_end(start))
        first.learn(given, search_px)  # compare all ends in the same colours
        coarse_ends.sort(key=lambda end: -first.log_likelihood(end, wide_prior))
        for coarse_end in coarse_ends[:NUM_CONTINUED]:
            with contextlib.suppress(UndecidedError):
                end = replace(descent, rounds=rounds[1:]).run(coarse_end).T_cam_obj
                # Weaken the prior until this end is at the expected squared distance, 6.
                factor = max(1.0, prior.squared_distance(end) / 6)
                weakened_prior = Prior(given, prior.information / factor)
                outcome = Descent([last], weakened_prior, search_px).refine(end)
                least = MIN_AGREEMENT if best is None else best[1].share
                if outcome[1].share >= least and outcome[1].support >= least_support:
                    best = outcome
            if best is not None and best[1].share >= CERTAIN:
                break
    return best


def necessary_rounds(rounds: Sequence[Round], reach: float) -> Sequence[Round]:
    """Drop each coarse round if the next covers the share ``MIN_COVERED`` of the search distance.

    Args:
        rounds: Rounds of optimisation, from coarse to fine.
        reach: Search distance, pixels of the image.
    """
    while len(rounds) > 1 and rounds[1].farthest(reach) >= MIN_COVERED * reach:
        rounds = rounds[1:]
    if len(rounds) == 1 and rounds[0].farthest(reach) < reach:
        # Run the last round twice: the second pass learns the colours at a better pose.
        return [*rounds, *rounds]
    return rounds


def has_converged(end: Solution, before: Transform) -> bool:
    """Return whether a round moved the pose by less than ``CONVERGED`` standard deviations."""
    return Prior(before, end.information).squared_distance(end.T_cam_obj) < CONVERGED**2


def search_distance(coarse: Round, prior: Prior) -> float:
    """Return how far from the projected outline to search for the part's border on the image.

    Args:
        coarse: First round of the refinement, with the smallest image.
        prior: Distribution of the pose before the refinement.

    Returns:
        Distance in pixels of the full image; it grows with the pose's standard deviation.

    Raises:
        UndecidedError: The image shows too little of the part's outline.
    """
    contour = coarse.contour(prior.T_cam_obj)
    if contour is None:
        raise UndecidedError("too little of the part's outline is on the image")
    crop = coarse.crop
    rows = outline_rows(contour, prior.T_cam_obj, crop.K)
    covariance = np.linalg.inv(prior.information)
    deviation = math.sqrt(float(np.mean(((rows @ covariance) * rows).sum(axis=1))))
    factor, most = REACH
    return max(EDGE_PX, min(factor * deviation, most * crop.extent) / crop.scale)
