"""Planning of a grasp from a part's estimated pose, as in a robot's controller.

The planner uses estimated poses, calibrated matrices and the robot's model, never the simulation's
true poses. Collisions are checked in a separate model with the parts at their estimated poses.
Inverse kinematics (by mink) takes differential steps within the joints' limits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Final

import mink
import mujoco
import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import Transform, make_transform, transform
from dopepp.geometry.rotation import Vector, rotation_angle, rotation_vector_to_matrix
from dopepp.robot.grasping.cell import FLANGE, HOME, JOINTS, Cell
from dopepp.robot.grasping.grasps import ABOVE_BENCH, INSERTIONS, PAD_HALF, Grasp
from dopepp.robot.grasping.unexplained import Unexplained
from dopepp.virtual.body import Hull

Joints = Float[np.ndarray, "6"]  # angles of the arm's joints, radians
Path = Float[np.ndarray, "waypoints 6"]  # joint angles, radians
POSITION_TOLERANCE: Final = 1e-4  # metres
ANGLE_TOLERANCE: Final = 1e-3  # radians
STEPS: Final = 60  # iterations of inverse kinematics; a reachable pose needs about ten
COMMANDS: Final = np.linspace(0.0, 255.0, 18)  # gripper commands, open to closed
# Largest estimated height above the bench of a part that lies on it, by layout, metres. In a heap,
# a part that leans on another part is not much higher.
MAX_HEIGHTS: Final = {"single": 0.005, "distractors": 0.005, "heap": 0.002}
MAX_APPROACH_ANGLE: Final = np.radians(40.0)  # largest angle between an approach and straight down
RETREAT: Final = 0.06  # length of the straight descent, metres
LIFT: Final = 0.12  # height of the lift, metres
CHECKS: Final = 24  # collision checks per radian of a path
PENETRATION: Final = 1e-4  # minimum penetration of a collision of the robot, metres
CARRIED_PENETRATION: Final = 1e-3  # minimum penetration of a collision of the carried part, metres
LIFT_CHECKS: Final = 25  # collision checks of a lift: every 5 mm
DISTURBING: Final = 0.3  # factor on the quality of a grasp whose lift moves other objects
SHALLOW_FACTOR: Final = 0.2  # smallest factor on the quality of a grasp less than 3 mm deep
SHIFT: Final = 0.002  # displacements of the hand for the margin of a grasp, metres


class Arm:
    """Forward and inverse kinematics of the arm's model, without the errors of a real arm."""

    def __init__(self) -> None:
        self._cell = Cell(gripper=False)
        self._configuration = mink.Configuration(self._cell.model)
        self._task = mink.FrameTask(FLANGE, "site", 1.0, 1.0, lm_damping=1e-3)
        self._limits = [mink.ConfigurationLimit(self._cell.model)]

    def flange(self, joints: Joints) -> Transform:
        """Return T_base_flange at joint angles, metres."""
        self._configuration.update(joints)
        return self._cell.flange_pose(self._configuration.data)

    def joints(self, T_base_flange: Transform, near: Joints = HOME) -> Joints | None:
        """Return joint angles, searched from ``near``, with the flange at a pose; None if none."""
        self._configuration.update(np.array(near))
        self._task.set_target(mink.SE3.from_matrix(T_base_flange))
        for _ in range(STEPS):
            current = self._cell.flange_pose(self._configuration.data)
            shift = np.linalg.norm(current[:3, 3] - T_base_flange[:3, 3])
            angle = rotation_angle(current[:3, :3].T @ T_base_flange[:3, :3])
            if shift < POSITION_TOLERANCE and angle < ANGLE_TOLERANCE:
                return np.array(self._configuration.q[:JOINTS])
            velocity = mink.solve_ik(
                self._configuration, [self._task], 1.0, "daqp", limits=self._limits, damping=1e-6
            )
            self._configuration.integrate_inplace(np.clip(velocity, -0.5, 0.5), 1.0)
        return None


@dataclass(frozen=True, eq=False)
class Gripper:
    """Kinematics of the gripper's fingers, tabulated by :data:`COMMANDS`; metres and radians."""

    widths: Float[np.ndarray, "commands"]  # distance between the pads, descending
    reaches: Float[np.ndarray, "commands"]  # from flange to pads' ends: fingers swing forward
    joints: Float[np.ndarray, "commands 8"]

    @property
    def widest(self) -> float:
        """Largest distance between the pads."""
        return float(self.widths[0])

    def command(self, width: float) -> float:
        """Return the command (0 open, 255 closed) at which the pads are ``width`` apart."""
        return float(np.interp(-width, -self.widths, COMMANDS))

    def reach(self, width: float) -> float:
        """Return the distance from flange to pads' ends while the pads are ``width`` apart."""
        return float(np.interp(-width, -self.widths, self.reaches))

    def fingers(self, width: float) -> Float[np.ndarray, "8"]:
        """Return MuJoCo's finger joint angles while the pads are ``width`` apart."""
        command = self.command(width)
        return np.array([np.interp(command, COMMANDS, joint) for joint in self.joints.T])


def measure_gripper() -> Gripper:
    """Measure the gripper's kinematics in a simulation of the closing fingers."""
    cell = Cell()
    state = cell.data()
    widths, reaches, joints = [], [], []
    for command in COMMANDS:
        state.ctrl[JOINTS] = command
        mujoco.mj_step(cell.model, state, nstep=300)
        T_flange_base = np.linalg.inv(cell.flange_pose(state))
        left, right = (
            T_flange_base[:3, :3] @ state.geom_xpos[pad] + T_flange_base[:3, 3] for pad in cell.pads
        )
        widths.append(float(abs(left[0] - right[0])) - 2 * PAD_HALF[0])
        reaches.append(float(left[2] + right[2]) / 2 + PAD_HALF[2])
        joints.append(state.qpos[cell.fingers].copy())
    return Gripper(np.array(widths), np.array(reaches), np.array(joints))


@dataclass(frozen=True, eq=False)
class ControllerParameters:
    """Calibrated poses of camera, tool tip and bench that the robot's controller uses."""

    T_flange_cam: Transform
    tip: Vector  # midpoint between the ends of the closed fingers, flange frame, metres
    T_base_bench: Transform  # z is the bench's upward normal


@dataclass(frozen=True, eq=False)
class Plan:
    """Arm motion of a grasp: joint angles at the waypoints of its three phases."""

    approach: Path  # from the start to :data:`RETREAT` before the grasp
    descent: Path  # along the grasp's approach direction to the part
    lift: Path  # along the bench's normal
    opening: float  # distance between the fingers before they close, metres
    grasp: Grasp
    quality: float  # in (0, 1]; 1 for a level, free part and much room for the fingers


def align_with_bench(
    T_base_obj: Transform, hull: Hull, T_base_bench: Transform, low: float
) -> Transform:
    """Rotate and move an estimated pose so that the part's lowest stable face lies on the bench.

    An image from above determines tilt and height poorly; the bench determines both well. If the
    lowest point is more than ``low`` (metres) above or below the bench after the rotation, the part
    leans on another object, and its pose is returned unchanged.
    """
    up = T_base_bench[:3, 2]
    normals = hull.rests[0] @ T_base_obj[:3, :3].T
    down = normals[int(np.argmin(normals @ up))]
    axis, cosine = np.cross(down, -up), float(-down @ up)
    sine = float(np.linalg.norm(axis))
    R = rotation_vector_to_matrix(axis * (np.arctan2(sine, cosine) / sine if sine else 0.0))
    centre = transform(T_base_obj, hull.centre)
    position = centre + R @ (T_base_obj[:3, 3] - centre)
    flat = make_transform(R @ T_base_obj[:3, :3], position)
    lowest = float(((transform(flat, hull.vertices) - T_base_bench[:3, 3]) @ up).min())
    if abs(lowest) > low:
        return T_base_obj
    flat[:3, 3] -= lowest * up
    return flat


class Planner:
    """Planner of collision-free arm motions for grasps.

    ``cell`` is the model for collision checks, with at least as many parts as the plans consider.
    ``tilts`` are rotations of the hand about the closing direction, radians. Later rotations are
    tried if no grasp is feasible with the earlier rotations.
    """

    def __init__(
        self,
        arm: Arm,
        gripper: Gripper,
        cell: Cell,
        knowledge: ControllerParameters,
        tilts: Sequence[float] = (0.0,),
    ) -> None:
        self.arm, self._gripper, self._cell, self.knowledge = arm, gripper, cell, knowledge
        self._tilts = tilts
        self._state = cell.data()
        model = cell.model
        self._hand = np.array(["gripper/" in model.body(body).name for body in model.geom_bodyid])

    def plan(
        self,
        poses: Sequence[Transform],
        grasps: Sequence[Grasp],
        start: Joints,
        unexplained: Unexplained | None = None,
    ) -> Plan | None:
        """Plan a motion from joint angles that grasps the first of several parts at T_base_obj.

        The fingers do not descend into regions of ``unexplained``.

        Returns:
            The motion of the first grasp that is reachable, and with which the hand approaches,
            closes and lifts without a collision, or None.
        """
        self._place(poses)
        for tilt, insertion, grasp in product(self._tilts, INSERTIONS, grasps):
            for tool, depth in self._tools(poses[0], grasp, tilt, insertion):
                if unexplained is not None and unexplained.blocks(tool, grasp.opening):
                    continue
                motion = self._motion(poses[0], tool, grasp, start)
                if motion is not None:
                    grip = max(SHALLOW_FACTOR, min(depth / INSERTIONS[1], 1.0))
                    return replace(motion, quality=motion.quality * grip)
        return None

    def can_move(self, poses: Sequence[Transform], start: Joints, end: Joints) -> bool:
        """Return whether the open hand can move straight in joint space with parts at ``poses``."""
        self._place(poses)
        return self._is_free(np.stack([start, end]), self._gripper.widest)

    def _place(self, poses: Sequence[Transform]) -> None:
        """Place as many of the model's parts as possible at T_base_obj, and put others away."""
        for number in range(self._cell.count):
            self._cell.put_away(self._state, number)
        for number, pose in enumerate(poses[: self._cell.count]):
            self._cell.put(self._state, number, pose)

    def _tools(
        self, T_base_obj: Transform, grasp: Grasp, tilt: float, insertion: float
    ) -> Iterator[tuple[Transform, float]]:
        """Yield T_base_tool of the pads' ends and their depth for a grasp and its half turn.

        The depth beyond the grasp's point is ``insertion``, or for the largest insertion as much as
        the bench allows, metres. A pose is omitted if it is tilted by more than
        :data:`MAX_APPROACH_ANGLE` or touches the bench.
        """
        up = self.knowledge.T_base_bench[:3, 2]
        signs = np.array(list(product((-1, 1), (-1, 1), [0])))
        ends = signs * [grasp.width / 2 + 2 * PAD_HALF[0], PAD_HALF[1], 0.0]
        R_tilt = rotation_vector_to_matrix(np.array([tilt, 0.0, 0.0]))
        for flipped in (False, True):
            T = T_base_obj @ grasp.T_obj_tool(flipped) @ make_transform(R_tilt, np.zeros(3))
            steep = -float(T[:3, 2] @ up)
            if steep < np.cos(MAX_APPROACH_ANGLE):
                continue
            points = ends @ T[:3, :3].T + T[:3, 3] - self.knowledge.T_base_bench[:3, 3]
            room = (float((points @ up).min()) - ABOVE_BENCH) / steep
            if room >= 0 and (insertion < room or insertion == INSERTIONS[0]):
                depth = min(room, insertion)
                yield make_transform(T[:3, :3], T[:3, 3] + depth * T[:3, 2]), depth

    def _motion(
        self, T_base_obj: Transform, T_base_tool: Transform, grasp: Grasp, start: Joints
    ) -> Plan | None:
        """Return a plan that moves the pads' ends to a pose, or None if blocked or out of reach."""
        up = self.knowledge.T_base_bench[:3, 2]
        tip = self.knowledge.tip.copy()
        tip[2] += self._gripper.reach(grasp.width) - self._gripper.reach(0.0)
        T_base_flange = T_base_tool @ make_transform(np.eye(3), -tip)
        # Most candidates are blocked at the part, so this pose is checked before a path is planned.
        at_part = self.arm.joints(T_base_flange, start)
        if at_part is None or not self._can_close(at_part, grasp):
            return None
        before, above = T_base_flange.copy(), T_base_flange.copy()
        before[:3, 3] -= RETREAT * T_base_flange[:3, 2]
        above[:3, 3] += LIFT * up
        first = self.arm.joints(before, start)
        descent = None if first is None else self._line(first, before, T_base_flange)
        if descent is None or not self._is_free(descent, grasp.opening):
            return None
        approach = np.stack([start, descent[0]])
        if not self._is_free(approach, grasp.opening):
            return None
        lift = self._line(descent[-1], T_base_flange, above)
        freedom = 0.0 if lift is None else self._lift_freedom(lift, grasp.width, T_base_obj)
        if lift is None or not freedom:
            return None
        steep, level = -float(T_base_tool[:3, 2] @ up), 1 - float(T_base_tool[:3, 0] @ up) ** 2
        quality = steep * level * freedom * self._margin(T_base_flange, at_part, grasp)
        return Plan(approach, descent, lift, grasp.opening, grasp, quality)

    def _can_close(self, joints: Joints, grasp: Grasp) -> bool:
        """Return whether the hand is free at a grasp, open and when the fingers touch the part."""
        is_blocked = self._collides(joints, grasp.opening)
        return not (is_blocked or self._collides(joints, grasp.width, carries=True))

    def _lift_freedom(self, path: Path, width: float, T_base_obj: Transform) -> float:
        """Return how freely the first part can be lifted from ``T_base_obj`` along a path.

        The result is 0 if the hand hits an object, :data:`DISTURBING` if the part does, else 1.
        """
        T_flange_obj = np.linalg.inv(self.arm.flange(path[0])) @ T_base_obj
        shares = np.linspace(0, len(path) - 1, LIFT_CHECKS)[1:]
        freedom = 1.0
        for joints in np.stack([np.interp(shares, range(len(path)), q) for q in path.T], axis=1):
            self._cell.put(self._state, 0, self.arm.flange(joints) @ T_flange_obj)
            if self._collides(joints, width, carries=True):
                freedom = 0.0
                break
            if self._is_part_hit():
                freedom = DISTURBING
        self._cell.put(self._state, 0, T_base_obj)
        return freedom

    def _margin(self, T_base_flange: Transform, joints: Joints, grasp: Grasp) -> float:
        """Return a share from 0.2 to 1: how often a hand displaced by :data:`SHIFT` is free."""
        num_free = 1
        for shift in ([SHIFT, 0, 0], [-SHIFT, 0, 0], [0, SHIFT, 0], [0, -SHIFT, 0]):
            displaced = T_base_flange @ make_transform(np.eye(3), np.array(shift))
            beside = self.arm.joints(displaced, joints)
            num_free += beside is not None and not self._collides(beside, grasp.opening)
        return num_free / 5

    def _line(self, start: Joints, T_from: Transform, T_to: Transform) -> Path | None:
        """Return joints that move the flange straight, or None if a pose is out of reach."""
        path = [start]
        for share in np.linspace(0, 1, 7)[1:]:
            between = T_to.copy()
            between[:3, 3] = (1 - share) * T_from[:3, 3] + share * T_to[:3, 3]
            joints = self.arm.joints(between, path[-1])
            if joints is None:
                return None
            path.append(joints)
        return np.stack(path)

    def _is_free(self, path: Path, opening: float) -> bool:
        """Return whether a path, linear in joint space, is free with the pads ``opening`` apart."""
        for here, there in pairwise(path):
            count = max(2, round(CHECKS * float(np.abs(there - here).max())))
            for share in np.linspace(0, 1, count):
                if self._collides((1 - share) * here + share * there, opening):
                    return False
        return True

    def _collides(self, joints: Joints, opening: float, carries: bool = False) -> bool:
        """Return whether the robot collides with the pads ``opening`` apart.

        If the hand ``carries`` the first part, it may touch this part.
        """
        state, cell = self._state, self._cell
        state.qpos[:JOINTS] = joints
        state.qpos[cell.fingers] = self._gripper.fingers(opening)
        mujoco.mj_kinematics(cell.model, state)
        mujoco.mj_comPos(cell.model, state)
        mujoco.mj_collision(cell.model, state)
        groups = cell.groups[state.contact.geom]
        hits = (groups == 0).any(axis=1) & ~self._hand[state.contact.geom].all(axis=1)
        if carries:
            hits &= ~(groups == 1).any(axis=1)
        return bool((hits & (state.contact.dist < -PENETRATION)).any())

    def _is_part_hit(self) -> bool:
        """Return whether the first part penetrates bench or another part at the last check."""
        contact = self._state.contact
        groups = self._cell.groups[contact.geom]
        is_part = groups == 1
        hits = is_part.any(axis=1) & ~(is_part | (groups == 0)).all(axis=1)
        return bool((hits & (contact.dist < -CARRIED_PENETRATION)).any())
