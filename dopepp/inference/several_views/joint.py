"""Joint pose of the observations of one part: refinement on all views, and verification in each.

Views that do not show the part at the joint pose are excluded, and the pose is refined again on the
remaining views. If fewer than two views show the part, it keeps the pose and the observation of its
best single view.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID
from dopepp.inference.network_input import are_same
from dopepp.inference.refinement.joint_refinement import (
    JointRefinement,
    PosedImage,
    rotate_covariance,
)
from dopepp.inference.refinement.refiner import INFLATION, Refiner
from dopepp.inference.refinement.region.round import OutlineAgreement
from dopepp.inference.refinement.solver import PoseMatrix, Prior, UndecidedError
from dopepp.inference.several_views.observations import PartGeometry, PartObservation, separation
from dopepp.inference.several_views.views_result import Status, ViewEvidence, WorldDetection
from dopepp.recovery.detection import PROBABLE, Detection, log_odds, to_probability

SUPPORTING: Final = 0.2
"""Smallest probability at which a view supports a pose."""

AGREEING: Final = 0.7
"""Smallest agreement of the outline (:class:`OutlineAgreement`) at which a view supports a pose. At
correct poses, the agreement is above 0.9. If a camera's position has an error of 4 mm at a distance
of 20 cm, the agreement is below 0.7 in one view."""

SUPPORT_LIMITS: Final = (0.5, 0.15)
"""Factor on the probability and decrease of the agreement of a view's detection, down to which the
view also supports the joint pose."""

RELIABLE: Final = 0.1
"""Smallest probability of a detection that lowers its view's limits by :data:`SUPPORT_LIMITS`."""

CONSISTENT: Final = 4.5
"""Largest Mahalanobis distance at which the covariances of two poses explain their difference."""

MIN_LOG_ODDS: Final = -1.5
"""Lower bound of a view's log odds, because the part may be occluded or hardly visible."""

COINCIDENCE: Final = 1.5
"""Log odds added by each further view that detects the part at the same pose, or whose outline
agrees: wrong poses rarely fit two views."""

REGULAR: Final = 1e-3
"""Share of a forecast's information that keeps the information of the views invertible."""

USUAL_MOVE: Final = 1.0
"""Assumed Mahalanobis distance between start and refined pose, a feature of the verification."""

Search = Callable[[PartObservation], PartObservation | None]
"""Returns an observation at the same centroid with another pose; None if none is found."""


@dataclass(frozen=True, eq=False)
class JointPart:
    """A part detected in the world, with the observations in single views that belong to it."""

    observations: Sequence[PartObservation]
    detection: WorldDetection


@dataclass(frozen=True, eq=False)
class JointEstimator:
    """Estimates poses of parts in the world from all views together."""

    refiner: Refiner  # refines and verifies poses on the image
    views: Sequence[PosedImage]  # images of the scene
    names: Sequence[str]  # name of each view
    geometries: Mapping[str, PartGeometry]  # geometry of each part
    slope: float  # weight of the log odds of ``Detection.probability`` in the score

    def parts(
        self, clusters: Sequence[Sequence[PartObservation]], search: Search
    ) -> list[JointPart]:
        """Estimate one part per cluster of observations, drop duplicates, and sort by score.

        Each observation that disagrees with its cluster's joint pose becomes a separate cluster.
        Where no pose is probable, ``search`` returns another start. Its result is used if it is
        probable and at least two views show the part.

        Args:
            clusters: Observations of each possible part, best first; the best cluster first.
            search: Search in the belief maps of all views.
        """
        parts: list[JointPart] = []
        waiting = list(clusters)
        while waiting:
            cluster = waiting.pop(0)
            part = self.estimate(cluster)
            waiting += [[other] for other in cluster if other not in part.observations]
            is_doubtful = part.detection.probability < PROBABLE
            if is_doubtful and not any(_is_at(found, cluster[0]) for found in parts):
                searched = search(cluster[0])
                other = part if searched is None else self.estimate([searched])
                if other.detection.probability >= PROBABLE and len(other.detection.views) > 1:
                    part = other
                    waiting = [rest for rest in waiting if not _is_at(part, rest[0])]
            parts.append(part)
        parts.sort(key=lambda part: -part.detection.score)
        kept: list[JointPart] = []
        for part in parts:
            if not any(_is_duplicate(part, better) for better in kept):
                kept.append(part)
        return kept

    def estimate(self, observations: Sequence[PartObservation]) -> JointPart:
        """Refine the pose of a part on all views that show it.

        Args:
            observations: Observations of the part, best first.

        Returns:
            The part with the observations that agree with the joint pose. If no two views agree,
            the pose is that of the best observation.
        """
        name, all_views = observations[0].detection.object, set(range(len(self.views)))
        geometry = self.geometries[name]
        # Refine on the selected views, select the views that support the result, and repeat.
        selected, tried = all_views, list[tuple[set[int], int]]()
        while len(selected) > 1 and (selected, len(observations)) not in tried:
            tried.append((selected, len(observations)))
            start = geometry.mean([observation.pose for observation in observations])
            search_range = Prior(start.T_cam_obj, start.information / INFLATION**2)
            views_with_observation = {observation.view for observation in observations}
            numbers = sorted(selected)
            starts = [item.start for item in observations if item.view in selected]
            prior = geometry.mean(starts or [observations[0].start])
            try:
                views = [self.views[number] for number in numbers]
                joint = self.refiner.refine_views(name, views, search_range, prior)
            except UndecidedError:
                break
            pose = Prior(joint.T_world_obj, np.linalg.inv(joint.covariance))
            shown = dict(zip(numbers, joint.agreements, strict=True))
            evidence = [
                self._evidence(number, pose, observations, shown.get(number))
                for number in all_views
            ]
            supporting = {n for n in all_views if evidence[n].status == "supports"}
            # An observation whose refinement failed (`kept`) may be wrong. If it contradicts the
            # pose that several views support, refine again without this observation.
            consistent = [
                item
                for item in observations
                if not item.detection.kept or geometry.separation(pose, item.pose) <= CONSISTENT
            ]
            if len(supporting) > 1 and 0 < len(consistent) < len(observations):
                observations, selected = consistent, supporting
                continue
            if supporting >= selected:
                agreeing = [item for item in observations if item.view in selected] or observations
                disagreement = max(joint.disagreements)
                if len(agreeing) > 1:
                    separations = [geometry.separation(pose, item.pose) for item in agreeing]
                    disagreement = max(disagreement, min(separations) / math.sqrt(6))
                # Above 1, errors are larger than their covariances: increase the covariance.
                looser = Prior(pose.T_cam_obj, pose.information / max(1.0, disagreement) ** 2)
                return self._part(agreeing, looser, evidence, disagreement)
            several = len(supporting & selected) > 1
            selected = supporting & selected if several else views_with_observation
        best = max(observations, key=lambda observation: observation.detection.score)
        detection = best.detection
        probability = detection.probability or 0.0
        evidence = [
            self._evidence(number, best.pose, [best], None)
            if number != best.view
            else ViewEvidence(self.names[number], "supports", probability, detection)
            for number in all_views
        ]
        return self._part([best], best.pose, evidence)

    def follow(
        self, part: WorldDetection, forecast: Prior
    ) -> tuple[WorldDetection, PoseMatrix] | None:
        """Refine a tracked part on all views that show it, without a search in single views.

        Views whose outline agrees less than :data:`AGREEING` are excluded, e.g. if the part is
        occluded there. The part keeps its score and its probabilities.

        Args:
            part: The part in the previous images, with evidence of the same views.
            forecast: Predicted pose in the world, with its uncertainty.

        Returns:
            The part, and its covariance without the lasting errors of the camera poses, from which
            a filter continues. None if no view shows the part.
        """
        shown = dict[int, OutlineAgreement | None]()
        supporting = set(range(len(self.views)))
        selected: set[int] = set()
        while supporting and supporting != selected:
            selected = supporting
            try:
                views = [self.views[number] for number in sorted(selected)]
                joint = self.refiner.refine_views(part.object, views, forecast, forecast, True)
            except UndecidedError:
                return None
            shown |= dict(zip(sorted(selected), joint.agreements, strict=True))
            supporting = {n for n in selected if (item := shown[n]) and item.share >= AGREEING}
        if not supporting:
            return None
        covariance = joint.covariance * max(1.0, *joint.disagreements) ** 2
        lasting = covariance + _lasting_error(joint, views, forecast)
        pose = Prior(joint.T_world_obj, np.linalg.inv(lasting))
        moved = self.moved(part, pose, shown, supporting, max(joint.disagreements))
        return moved, covariance

    def moved(
        self,
        part: WorldDetection,
        pose: Prior,
        agreements: Mapping[int, OutlineAgreement | None],
        supporting: Set[int],
        disagreement: float,
    ) -> WorldDetection:
        """Return a part at another pose.

        Args:
            part: The part, with evidence of the same views.
            pose: New pose in the world.
            agreements: Agreement of the outline at the new pose, by index of the view.
            supporting: Indices of the views that show the part.
            disagreement: See :class:`WorldDetection`.
        """
        evidence = []
        for number, item in enumerate(part.evidence):
            detection = self._in_view(number, pose, item.detection, agreements.get(number))
            status = "supports" if number in supporting else self._unsupported(number, detection)
            evidence.append(replace(item, status=status, detection=detection))
        return replace(
            part,
            T_world_obj=pose.T_cam_obj,
            covariance=np.linalg.inv(pose.information),
            evidence=evidence,
            disagreement=disagreement,
        )

    def _in_view(
        self, number: int, pose: Prior, detection: Detection, agreement: OutlineAgreement | None
    ) -> Detection:
        """Return a detection in the camera of a view, at a pose in the world."""
        view = self.views[number]
        distribution = view.to_camera(pose.T_cam_obj, np.linalg.inv(pose.information))
        T_cam_obj, cuboid = distribution.T_cam_obj, self.geometries[detection.object].cuboid
        return replace(
            detection,
            T_cam_obj=T_cam_obj,
            keypoints=project_keypoints(cuboid, T_cam_obj, view.K),
            covariance=np.linalg.inv(distribution.information),
            agreement=None if agreement is None else agreement.share,
            support=None if agreement is None else agreement.support,
        )

    def _unsupported(self, number: int, detection: Detection) -> Status:
        """Return why a view does not support a pose: it is outside the image, or hidden."""
        centre, size = detection.keypoints[CENTROID], self.views[number].image.shape[1::-1]
        return "hidden" if ((centre >= 0) & (centre < size)).all() else "outside"

    def _evidence(
        self,
        number: int,
        pose: Prior,
        observations: Sequence[PartObservation],
        agreement: OutlineAgreement | None,
    ) -> ViewEvidence:
        """Return the visibility and probability in one view of a part at a pose in the world."""
        view = self.views[number]
        observation = next((item for item in observations if item.view == number), None)
        original = observations[0].detection if observation is None else observation.detection
        geometry = self.geometries[original.object]
        detection = self._in_view(number, pose, original, agreement)
        if observation is None:
            detection = replace(detection, peaks=np.full_like(original.peaks, np.nan))
        detection = self.refiner.verified(detection, view.image, view.K, USUAL_MOVE)
        probability, share = detection.probability or 0.0, detection.agreement or 0.0
        least, least_share = SUPPORTING, AGREEING
        own_probability = original.probability or 0.0
        if observation is not None and not original.kept and own_probability >= RELIABLE:
            factor, decrease = SUPPORT_LIMITS
            least = min(least, factor * own_probability)
            least_share = min(least_share, (original.agreement or 0.0) - decrease)
        is_shown = agreement is not None and probability >= least and share >= least_share
        if observation is not None and original.kept:
            is_shown |= geometry.separation(pose, observation.pose) <= CONSISTENT
        status = self._unsupported(number, detection)
        status = "supports" if is_shown and status == "hidden" else status
        return ViewEvidence(self.names[number], status, probability, detection)

    def _part(
        self,
        observations: Sequence[PartObservation],
        pose: Prior,
        evidence: Sequence[ViewEvidence],
        disagreement: float = 0.0,
    ) -> JointPart:
        """Combine the probabilities of all views into the probability and score of a part."""
        best = max((item.detection for item in observations), key=lambda detection: detection.score)
        single_odds, odds = log_odds(best.probability or 0.0), 0.0
        for item in evidence:
            seen = max(MIN_LOG_ODDS, log_odds(item.probability))
            if item.detection is best:
                odds += single_odds
            elif item.status != "outside":
                odds += seen if item.status == "supports" else min(0.0, seen)
        agreeing = sum(
            item.status == "supports"
            and item.probability >= SUPPORTING
            and (item.detection.agreement or 0.0) >= AGREEING
            for item in evidence
        )
        odds += COINCIDENCE * (max(len(observations), agreeing) - 1)
        # The score of the best single view, with the log odds of all views instead of this view's.
        score = to_probability(log_odds(best.score) + self.slope * (odds - single_odds))
        covariance = np.linalg.inv(pose.information)
        given = best.object, score, to_probability(odds), pose.T_cam_obj, covariance
        return JointPart(observations, WorldDetection(*given, evidence, disagreement))


def _lasting_error(
    joint: JointRefinement, views: Sequence[PosedImage], forecast: Prior
) -> PoseMatrix:
    """Return the covariance of a tracked pose due to the errors of the camera poses, world axes.

    These errors are the same on all images, so a filter does not reduce them. If the views have the
    errors e and the information W, the pose of a part at rest has the error (Σ W)⁻¹ Σ W e.

    Args:
        joint: Pose refined on all views.
        views: Views of ``joint``.
        forecast: Predicted pose of the part.
    """
    total, pulled = REGULAR * forecast.information, np.zeros((6, 6))
    for view, W in zip(views, joint.informations, strict=True):
        error = view.error_at(view.pose(joint.T_world_obj)[:3, 3])
        total = total + W
        pulled += W @ rotate_covariance(view.T_cam_world[:3, :3].T, error) @ W
    gain = np.linalg.inv(total)
    return np.asarray(gain @ pulled @ gain.T)


def _is_at(part: JointPart, observation: PartObservation) -> bool:
    """Return whether an observation is at the position of a probable part in its view."""
    seen = part.detection.evidence[observation.view].detection
    return part.detection.probability >= PROBABLE and are_same(seen, observation.detection)


def _is_duplicate(part: JointPart, better: JointPart) -> bool:
    """Return whether two parts are the same instance, detected twice.

    Both must be at the same position in every view. Either the covariances explain the difference
    of the poses, or the parts have observations of different views, and the better part is
    supported by all views of the other part. Otherwise the views contradict.
    """
    detection, other = part.detection, better.detection
    shared = {item.view for item in part.observations} & {item.view for item in better.observations}
    pairs = zip(detection.evidence, other.evidence, strict=True)
    if not all(are_same(a.detection, b.detection) for a, b in pairs):
        return False
    is_supported = not shared and set(detection.views) <= set(other.views)
    return is_supported or separation(detection.pose, other.pose) <= CONSISTENT
