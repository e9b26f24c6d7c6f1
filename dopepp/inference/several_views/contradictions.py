"""Contradictions between views: wrong or swapped camera poses, and moved parts.

Two views contradict each other if three conditions hold: they show a part of the same name at
different poses, the covariances do not explain the difference, and one view shows something else
where the other view's pose puts the part.

If the two views agree on no part, a camera pose is wrong, and the detections that depend on this
camera pose are rejected. If the views agree on another part, the contradicting part was moved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import Final, NamedTuple

import numpy as np

from dopepp.geometry.rotation import rotation_angle
from dopepp.inference.several_views.joint import CONSISTENT, JointEstimator
from dopepp.inference.several_views.observations import (
    PartObservation,
    associate,
    make_observation,
    separation,
)
from dopepp.inference.several_views.views_result import WorldDetection

DISAGREEING: Final = 1.2
"""Smallest reported disagreement of views on a part (:class:`WorldDetection`). With exact camera
poses, the largest of 30 disagreements on rendered scenes was 0.9."""

Views = Sequence[Sequence[PartObservation]]  # observations of each view


class _Conflict(NamedTuple):
    """Two detections of parts with the same name that contradict each other."""

    views: tuple[int, int]  # for each detection, a view that supports it
    detections: tuple[WorldDetection, WorldDetection]
    is_mutual: bool  # whether both views show something else at the other's pose

    def describe(self, names: Sequence[str]) -> str:
        """Return the views, the part and the difference of its poses (mm and degrees) in words."""
        first, second = (detection.T_world_obj for detection in self.detections)
        shift = 1e3 * np.linalg.norm(first[:3, 3] - second[:3, 3])
        angle = math.degrees(float(rotation_angle(first[:3, :3] @ second[:3, :3].T)))
        seen = " and ".join(names[view] for view in self.views)
        return f"{seen} show {self.detections[0].object} {shift:.3g} mm and {angle:.2g}° apart"


def contradictions(
    detections: Sequence[WorldDetection], observations: Views, joint: JointEstimator
) -> tuple[list[WorldDetection], list[str]]:
    """Find contradictions between views, and reject detections that depend on a wrong camera pose.

    Args:
        detections: Detections in the world with at least the minimum score.
        observations: Observations of each view with at least the minimum score.
        joint: Estimator of joint poses on the views.

    Returns:
        Detections that no contradiction rejects, and a message for each contradiction.
    """
    names, supports = joint.names, [_support(detection) for detection in detections]
    confirmed = {pair for views in supports for pair in combinations(views, 2)}
    trusted = {view for pair in confirmed for view in pair}
    findings: list[str] = []
    rejected: list[WorldDetection] = []
    swapped: tuple[int, int] | None = None
    for first, second in combinations(detections, 2):
        conflict = _conflict(first, second)
        if conflict is None:
            continue
        views, text = conflict.views, conflict.describe(names)
        if (min(views), max(views)) in confirmed:
            if conflict.is_mutual:
                cause = "it was moved between the images, or each image hides one of two parts"
                findings.append(f"{text}: {cause}")
            continue
        blamed = [n for n in (0, 1) if views[n] not in trusted]
        blamed = blamed if len(blamed) == 1 else [0, 1]
        rejected += [conflict.detections[number] for number in blamed]
        swapped = swapped or _swapped(observations, joint)
        if len(blamed) == 1:
            cause = f"the camera pose of {names[views[blamed[0]]]} is wrong"
        else:
            cause = "a camera pose is wrong, or the part was moved between the images"
        if swapped is not None:
            pair = " and ".join(names[view] for view in swapped)
            cause = f"the camera poses of {pair} are swapped"
        findings.append(f"{text}: {cause}")
    for detection in detections:
        if detection.disagreement > DISAGREEING:
            findings.append(
                f"{' and '.join(detection.views)} disagree on {detection.object} by "
                f"{detection.disagreement:.2g} standard deviations: calibrate the camera poses "
                "again, or state their errors"
            )
    remaining = [item for item in detections if not any(item is other for other in rejected)]
    return remaining, findings


def _support(detection: WorldDetection) -> list[int]:
    """Return the indices of the views that support a detection."""
    return [n for n, item in enumerate(detection.evidence) if item.status == "supports"]


def _conflict(first: WorldDetection, second: WorldDetection) -> _Conflict | None:
    """Return the contradiction of two detections, or None if their views do not contradict.

    Of several pairs of views that contradict, a pair in which both views show something else at the
    other's pose is preferred.
    """
    if first.object != second.object or separation(first.pose, second.pose) <= CONSISTENT:
        return None
    conflicts = []
    for a, b in product(_support(first), _support(second)):
        statuses = first.evidence[b].status, second.evidence[a].status
        if "supports" not in statuses and "hidden" in statuses:
            is_mutual = statuses == ("hidden", "hidden")
            conflicts.append(_Conflict((a, b), (first, second), is_mutual))
    return max(conflicts, key=lambda conflict: conflict.is_mutual, default=None)


def _swapped(observations: Views, joint: JointEstimator) -> tuple[int, int] | None:
    """Return the two views whose swapped camera poses associate most observations, or None."""
    images = joint.views

    def agreeing(order: Sequence[int]) -> int:
        views = [
            replace(image, T_cam_world=images[other].T_cam_world)
            for image, other in zip(images, order, strict=True)
        ]
        moved_observations = [
            [make_observation(item.view, item.detection, views[item.view]) for item in view]
            for view in observations
        ]
        clusters = associate(moved_observations, joint.geometries)
        return sum(len(cluster) - 1 for cluster in clusters)

    order = list(range(len(images)))
    exchanged = {}
    for first, second in combinations(order, 2):
        other = order.copy()
        other[first], other[second] = second, first
        exchanged[first, second] = agreeing(other)
    best = max(exchanged, key=lambda pair: exchanged[pair])
    return best if exchanged[best] > agreeing(order) else None
