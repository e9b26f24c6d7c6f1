"""Selection of the part of a heap to grasp next.

A part is preferred if its pose is probably correct, its grasp is good, little of it lies below
other parts, and no earlier attempt to grasp it failed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import KDTree

from dopepp.geometry.camera import Transform, transform
from dopepp.robot.grasping.grasps import Grasp, Points
from dopepp.robot.grasping.planner import Joints, Plan, Planner

BESIDE: Final = 0.003  # largest horizontal distance of a point above another point, metres
ABOVE: Final = 0.002  # smallest height of a point above another point, metres
SAME: Final = 0.01  # largest distance between two estimates of a part that has not moved, metres
TRIED: Final = 0.3  # factor on the score of a part for each failed attempt to grasp it


@dataclass(frozen=True, eq=False)
class EstimatedPart:
    """A detected part in the arm's base frame."""

    T_base_obj: Transform
    probability: float = 1.0  # probability that the pose is correct


@dataclass(frozen=True, eq=False)
class Choice:
    """The part to grasp, and the motion that grasps the part."""

    number: int  # index of the part in the list of estimated parts
    plan: Plan


def pick_score(probability: float, graspability: float, covered: float, failures: int) -> float:
    """Return the preference for a part, from 0 to 1.

    It depends on the probability of its pose, the quality of its best grasp, the covered share of
    its surface, and the number of failed attempts to grasp it.
    """
    return probability * graspability * (1 - covered) * TRIED**failures


def covered_share(target: Transform, others: Sequence[Transform], points: Points) -> float:
    """Return the share of a part's surface points that lie below points of other parts.

    ``target`` and ``others`` are poses T_base_obj of equal parts; z of the base points upwards.
    """
    if not others:
        return 0.0
    own = transform(target, points)
    other = np.concatenate([transform(pose, points) for pose in others])
    below = KDTree(own[:, :2]).query_ball_point(other[:, :2], BESIDE)
    is_covered = np.zeros(len(own), bool)
    for height, near in zip(other[:, 2], below, strict=True):
        is_covered[[index for index in near if own[index, 2] < height - ABOVE]] = True
    return float(is_covered.mean())


def choose_part(
    planner: Planner,
    parts: Sequence[EstimatedPart],
    points: Points,
    grasps: Sequence[Grasp],
    start: Joints,
    failed: Sequence[Transform] = (),
) -> Choice | None:
    """Return the part with the largest :func:`pick_score`, or None if no part can be grasped.

    ``points`` are the surface of each part, and ``grasps`` its grasps, the best first. ``failed``
    are poses T_base_obj of parts that were not grasped in earlier attempts.
    """
    poses = [part.T_base_obj for part in parts]
    orders = [[poses[k], *poses[:k], *poses[k + 1 :]] for k in range(len(parts))]  # first to grasp
    factors = []
    for part, (pose, *others) in zip(parts, orders, strict=True):
        shifts = (np.linalg.norm(other[:3, 3] - pose[:3, 3]) for other in failed)
        failures = sum(bool(shift < SAME) for shift in shifts)
        factors.append((part.probability, covered_share(pose, others, points), failures))
    limits = [pick_score(chance, 1.0, covered, tried) for chance, covered, tried in factors]
    best: Choice | None = None
    best_score = 0.0
    for number in sorted(range(len(parts)), key=lambda number: -limits[number]):
        if limits[number] <= best_score:
            break  # not even a perfect grasp makes this part the best
        plan = planner.plan(orders[number], grasps, start)
        if plan is not None and limits[number] * plan.quality > best_score:
            best, best_score = Choice(number, plan), limits[number] * plan.quality
    return best
