"""The second view of a grasp: where the arm moves its camera after the first image.

Candidate camera positions lie on rings around the part, at the distance of the first camera pose.
The arm must reach them without a collision. The second image is taken at the candidate that is
expected to reduce the error of the part's pose most.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from dopepp.core.errors import UserError
from dopepp.geometry.camera import CameraMatrix, Transform, invert_transform, transform
from dopepp.geometry.rotation import Vector
from dopepp.inference.refinement.outline import OutlineMesh
from dopepp.inference.several_views.next_view import next_best_view
from dopepp.inference.several_views.views_result import WorldDetection
from dopepp.robot.grasping.cell import TRAY
from dopepp.robot.grasping.planner import Joints, Planner
from dopepp.robot.grasping.rehearsal import SIZE, downward_view

TILTS: Final = np.radians([15.0, 25.0, 35.0])  # tilt of the camera on each ring, radians
NUM_AZIMUTHS: Final = 8  # number of candidates on each ring


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
    for tilt in TILTS:
        for azimuth in np.linspace(0.0, 2 * np.pi, NUM_AZIMUTHS, endpoint=False):
            tilts = tilt * np.array([np.cos(azimuth), np.sin(azimuth)])
            T_base_cam = downward_view(point, distance, tilts, 0.0)
            joints = planner.arm.joints(T_base_cam @ T_cam_flange, start)
            if joints is not None:
                yield joints
