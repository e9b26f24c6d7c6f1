"""Selection of the part of a heap to grasp next, and of a second view of this part.

A part is preferred if its pose is probably correct, its grasp is good, little of it lies below
other parts, and no earlier attempt to grasp it failed.

Candidates for the second view lie on rings around the part, at the distance of the first camera
pose. The second image is taken at the candidate that the arm reaches without a collision, and that
is expected to reduce the error of the part's pose most.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from dopepp.core.errors import UserError
from dopepp.geometry.camera import CameraMatrix, Transform, invert_transform, transform
from dopepp.geometry.rotation import Vector
from dopepp.inference.refinement.outline import OutlineMesh
from dopepp.inference.several_views.next_view import next_best_view
from dopepp.inference.several_views.views_result import WorldDetection
from dopepp.robot.grasping.cell import TRAY
from dopepp.robot.grasping.grasps import Grasp, Points
from dopepp.robot.grasping.planner import Joints, Plan, Planner
from dopepp.robot.grasping.rehearsal import SIZE, downward_view
from dopepp.robot.grasping.unexplained import Unexplained

MAX_OFFSET: Final = 0.003  # largest horizontal distance of a point above another point, metres
MIN_HEIGHT: Final = 0.002  # smallest height of a point above another point, metres
MAX_MOTION: Final = 0.01  # distance between two estimates of a part that has not moved, metres
RETRY_FACTOR: Final = 0.3  # factor on the score of a part for each failed attempt to grasp it
VIEW_TILTS: Final = np.radians([15.0, 25.0, 35.0])  # tilt of the camera on each ring, radians
NUM_AZIMUTHS: Final = 8  # number of candidates on each ring


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
    return probability * graspability * (1 - covered) * RETRY_FACTOR**failures


def covered_share(target: Transform, others: Sequence[Transform], points: Points) -> float:
    """Return the share of a part's surface points that lie below points of other parts.

    ``target`` and ``others`` are poses T_base_obj of equal parts; z of the base points upwards.
    """
    if not others:
        return 0.0
    own = transform(target, points)
    other = np.concatenate([transform(pose, points) for pose in others])
    below = KDTree(own[:, :2]).query_ball_point(other[:, :2], MAX_OFFSET)
    is_covered = np.zeros(len(own), bool)
    for height, near in zip(other[:, 2], below, strict=True):
        is_covered[[index for index in near if own[index, 2] < height - MIN_HEIGHT]] = True
    return float(is_covered.mean())


def choose_part(
    planner: Planner,
    parts: Sequence[EstimatedPart],
    points: Points,
    grasps: Sequence[Grasp],
    start: Joints,
    failed: Sequence[Transform] = (),
    unexplained: Unexplained | None = None,
) -> Choice | None:
    """Return the part with the largest :func:`pick_score`, or None if no part can be grasped.

    ``points`` are the surface of each part, and ``grasps`` its grasps, the best first. ``failed``
    are poses T_base_obj of parts that were not grasped in earlier attempts. Grasps at
    ``unexplained`` regions of the image are chosen only if there are no others.
    """
    poses = [part.T_base_obj for part in parts]
    orders = [[poses[k], *poses[:k], *poses[k + 1 :]] for k in range(len(parts))]  # first to grasp
    factors = []
    for part, (pose, *others) in zip(parts, orders, strict=True):
        shifts = (np.linalg.norm(other[:3, 3] - pose[:3, 3]) for other in failed)
        failures = sum(bool(shift < MAX_MOTION) for shift in shifts)
        factors.append((part.probability, covered_share(pose, others, points), failures))
    limits = [pick_score(chance, 1.0, covered, tried) for chance, covered, tried in factors]
    best: Choice | None = None
    best_score = 0.0
    for number in sorted(range(len(parts)), key=lambda number: -limits[number]):
        if limits[number] <= best_score:
            break  # not even a perfect grasp makes this part the best
        plan = planner.plan(orders[number], grasps, start, unexplained)
        if plan is not None and limits[number] * plan.quality > best_score:
            best, best_score = Choice(number, plan), limits[number] * plan.quality
    if best is None and unexplained is not None:
        return choose_part(planner, parts, points, grasps, start, failed)
    return best


class Viewpoint(NamedTuple):
    """Joint angles at which the camera takes the second image, and the reason for this choice."""

    joints: Joints  # angles that the controller reads, radians
    reason: str


def choose_viewpoint(
    planner: Planner,
    K: CameraMatrix,
    start: Joints,
    parts: Sequence[WorldDetection],
    mesh: OutlineMesh,
) -> Viewpoint | None:
    """Return the view that is expected to reduce the pose error of the first part most.

    ``start`` are the joint angles at the first image, and ``parts`` its detections in the robot's
    base frame. Without a part, the first candidate in reach is returned. None means that the arm
    reaches no view that shows the whole part.
    """
    T_base_cam = _camera_pose(planner, start)
    middle = mesh.vertices.mean(axis=0)
    point = transform(parts[0].T_world_obj, middle) if parts else TRAY
    distance = float(np.linalg.norm(point - T_base_cam[:3, 3]))
    poses = [part.T_world_obj for part in parts]
    reached = [
        joints
        for joints in _candidates(planner, point, distance, start)
        if planner.can_move(poses, start, joints)
    ]
    cameras = [_camera_pose(planner, joints) for joints in reached]
    number, reason = 0, "shows the tray from another side"
    if parts:
        part, bench = parts[0], planner.knowledge.T_base_bench
        given = part.T_world_obj, part.covariance, cameras, K, SIZE, bench
        try:
            best = next_best_view(mesh, *given)
        except UserError:  # no candidate shows the whole part
            return None
        number, reason = best.number, best.reason
    if not reached:
        return None
    cosine = float(T_base_cam[:3, 2] @ cameras[number][:3, 2])
    angle = np.degrees(np.arccos(min(1.0, cosine)))
    reason = f"{angle:.0f}° from the first, {reason}; best of {len(reached)} in reach"
    return Viewpoint(reached[number], reason)


def _camera_pose(planner: Planner, joints: Joints) -> Transform:
    """Return T_base_cam by the controller's calibration, at the joint angles that it reads."""
    return np.asarray(planner.arm.flange(joints) @ planner.knowledge.T_flange_cam)


def _candidates(
    planner: Planner, point: Vector, distance: float, start: Joints
) -> Iterator[Joints]:
    """Yield joint angles of reachable camera poses at ``distance`` (metres) around a point."""
    T_cam_flange = invert_transform(planner.knowledge.T_flange_cam)
    for tilt in VIEW_TILTS:
        for azimuth in np.linspace(0.0, 2 * np.pi, NUM_AZIMUTHS, endpoint=False):
            tilts = tilt * np.array([np.cos(azimuth), np.sin(azimuth)])
            T_base_cam = downward_view(point, distance, tilts, 0.0)
            joints = planner.arm.joints(T_base_cam @ T_cam_flange, start)
            if joints is not None:
                yield joints
