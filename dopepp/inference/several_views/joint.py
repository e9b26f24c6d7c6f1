"""Joint pose of the sightings of one part: refinement on all views, and verification in each.

Views that do not show the part at the joint pose are left out, and the pose is refined again
without them. A part that fewer than two views show keeps its best single-view pose; its other
sightings are no longer sightings of this part.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from dopepp.geometry.camera import Transform, project_keypoints
from dopepp.geometry.cuboid import Cuboid
from dopepp.inference.refinement.refiner import Refiner
from dopepp.inference.refinement.region.round import OutlineAgreement
from dopepp.inference.refinement.several_views import PosedPicture
from dopepp.inference.refinement.solver import PoseMatrix, UndecidedError
from dopepp.inference.several_views.association import Group, Sighting, fused
from dopepp.inference.several_views.views_result import Status, ViewEvidence, WorldDetection
from dopepp.recovery.detection import log_odds

SUPPORTING: Final = 0.2
AGREEING: Final = 0.7
"""Probability, and share of the image's evidence about the outline that must agree with it, from
which a view supports a pose. At right poses the share is above 0.9; if a camera is off by 4 mm at
20 cm, it is below 0.7 in one view."""

AGAINST: Final = -1.5
"""Lower bound of the log odds of a view that does not support a pose: the part may be hidden."""

USUAL_MOVE: Final = 1.0
"""Mahalanobis distance from the network's pose, where the network has not found the part."""


@dataclass(frozen=True, eq=False)
class JointPart:
    """A part in the world, with the sightings that belong to it."""

    sightings: Sequence[Sighting]
    detection: WorldDetection


class JointEstimator:
    """Estimates the joint poses of parts.

    Args:
        refiner: Refines and verifies poses on the image.
        views: Pictures of the scene.
        names: Name of each view.
        slope: Weight of the verification's log odds in the score.
    """

    def __init__(
        self, refiner: Refiner, views: Sequence[PosedPicture], names: Sequence[str], slope: float
    ) -> None:
        self._refiner, self._views, self._names, self._slope = refiner, views, names, slope

    def estimate(self, sightings: Sequence[Sighting], group: Group, cuboid: Cuboid) -> JointPart:
        """Return the joint pose of the sightings of one part, with those that agree with it."""
        start = fused(sightings, group, cuboid)
        everything, tried = set(range(len(self._views))), list[set[int]]()
        chosen = everything
        while len(chosen) > 1 and chosen not in tried:
            tried.append(chosen)
            numbers = sorted(chosen)
            try:
                views = [self._views[number] for number in numbers]
                joint = self._refiner.refine_views(sightings[0].detection.object, views, start)
            except UndecidedError:
                break
            agreements = dict(zip(numbers, joint.agreements, strict=True))
            pose = joint.T_world_obj, joint.covariance
            evidence = self._evidence(sightings, cuboid, *pose, agreements)
            supporting = {n for n in everything if evidence[n].status == "supports"}
            if supporting >= chosen:
                own = [sighting for sighting in sightings if sighting.view in chosen]
                # Views that disagree more than they should state too small errors.
                disagreement = max(joint.disagreements)
                covariance = max(1.0, disagreement) ** 2 * joint.covariance
                return self._part(own, pose[0], covariance, evidence, disagreement)
            several = len(supporting & chosen) > 1
            chosen = supporting & chosen if several else {item.view for item in sightings}
        best = max(sightings, key=lambda sighting: sighting.detection.score)
        seen = best.detection
        pose = self._views[best.view].to_world(seen.T_cam_obj, seen.covariance)
        return self._part([best], *pose, self._evidence([best], cuboid, *pose, {}, best))

    def _evidence(
        self,
        sightings: Sequence[Sighting],
        cuboid: Cuboid,
        T_world_obj: Transform,
        covariance: PoseMatrix,
        agreements: dict[int, OutlineAgreement | None],
        only: Sighting | None = None,
    ) -> list[ViewEvidence]:
        """Return what each view shows at a pose; ``only`` is the sighting of a single view."""
        found = {sighting.view: sighting.detection for sighting in sightings}
        evidence = []
        for number, (view, name) in enumerate(zip(self._views, self._names, strict=True)):
            if only is not None and number == only.view:
                probability = only.detection.probability or 0.0
                evidence.append(ViewEvidence(name, "supports", probability, only.detection))
                continue
            at = view.to_camera(T_world_obj, covariance)
            T_cam_obj = at.T_cam_obj
            detection = replace(
                found.get(number, sightings[0].detection),
                T_cam_obj=T_cam_obj,
                keypoints=project_keypoints(cuboid, T_cam_obj, view.K),
                covariance=np.linalg.inv(at.information),
                kept="",
            )
            if number not in found:
                detection = replace(detection, peaks=np.full((9, 2), np.nan))
            agreement = agreements.get(number)
            share, support = (
                (0.0, 0.0) if agreement is None else (agreement.share, agreement.support)
            )
            detection = replace(detection, agreement=share, support=support)
            detection = self._refiner.verified(detection, view.image, view.K, USUAL_MOVE)
            probability = detection.probability or 0.0
            status: Status = "hidden"
            if not _is_inside(detection.keypoints[-1], view):
                status = "outside"
            elif probability >= SUPPORTING and share >= AGREEING:
                status = "supports"
            evidence.append(ViewEvidence(name, status, probability, detection))
        return evidence

    def _part(
        self,
        sightings: Sequence[Sighting],
        T_world_obj: Transform,
        covariance: PoseMatrix,
        evidence: Sequence[ViewEvidence],
        disagreement: float = 0.0,
    ) -> JointPart:
        """Return the detection of a part with the probability and score of all views."""
        odds = 0.0
        for item in evidence:
            if item.status == "supports":
                odds += log_odds(item.probability)
            elif item.status == "hidden":
                odds += min(0.0, max(AGAINST, log_odds(item.probability)))
        best = max((item.detection for item in sightings), key=lambda detection: detection.score)
        # The score of the best single view, with the odds of all views instead of its own.
        alone = log_odds(best.probability or 0.0)
        score = _probability(log_odds(best.score) + self._slope * (odds - alone))
        pose = T_world_obj, covariance
        name, probability = best.object, _probability(odds)
        detection = WorldDetection(name, score, probability, *pose, evidence, disagreement)
        return JointPart(sightings, detection)


def _probability(odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-odds))


def _is_inside(pixel: np.ndarray, view: PosedPicture) -> bool:
    height, width = view.image.shape[:2]
    return bool((pixel >= 0).all() and pixel[0] < width and pixel[1] < height)
