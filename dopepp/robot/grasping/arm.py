"""What the robot's controller knows of its arm and gripper: where joints take it, and the reverse.

Inverse kinematics is mink's: differential steps towards the pose, within the joints' limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mink
import mujoco
import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import Transform
from dopepp.geometry.rotation import rotation_angle
from dopepp.robot.grasping.cell import FLANGE, HOME, JOINTS, Cell

Joints = Float[np.ndarray, "6"]
"""Angles of the arm's joints, radians."""

POSITION_TOLERANCE: Final = 1e-4
ANGLE_TOLERANCE: Final = 1e-3
"""Metres and radians within which a pose is reached."""

STEPS: Final = 60
"""Of inverse kinematics; a reachable pose takes about ten."""

PAD_HALF: Final = np.array([0.004, 0.011, 0.009375])
"""Half a finger pad's thickness, width and length (2F-85; a finger has two, one behind the other),
metres."""

COMMANDS: Final = np.linspace(0.0, 255.0, 18)
"""Of the gripper, open to closed."""


class Arm:
    """An arm's kinematics, without errors."""

    def __init__(self) -> None:
        self._cell = Cell(gripper=False)
        self._configuration = mink.Configuration(self._cell.model)
        self._task = mink.FrameTask(FLANGE, "site", 1.0, 1.0, lm_damping=1e-3)
        self._limits = [mink.ConfigurationLimit(self._cell.model)]

    def flange(self, joints: Joints) -> Transform:
        """Return T_base_flange."""
        self._configuration.update(joints)
        return self._cell.flange_pose(self._configuration.data)

    def joints(self, T_base_flange: Transform, near: Joints = HOME) -> Joints | None:
        """Return joints, close to others, that take the flange to a pose; None out of reach."""
        self._configuration.update(np.array(near))
        self._task.set_target(mink.SE3.from_matrix(T_base_flange))
        for _ in range(STEPS):
            if self._is_there(T_base_flange):
                return np.array(self._configuration.q[:JOINTS])
            velocity = mink.solve_ik(
                self._configuration, [self._task], 1.0, "daqp", limits=self._limits, damping=1e-6
            )
            self._configuration.integrate_inplace(np.clip(velocity, -0.5, 0.5), 1.0)
        return None

    def _is_there(self, T_base_flange: Transform) -> bool:
        here = self._cell.flange_pose(self._configuration.data)
        away = np.linalg.norm(here[:3, 3] - T_base_flange[:3, 3])
        turned = rotation_angle(here[:3, :3].T @ T_base_flange[:3, :3])
        return bool(away < POSITION_TOLERANCE and turned < ANGLE_TOLERANCE)


@dataclass(frozen=True, eq=False)
class Gripper:
    """How the fingers move.

    Attributes:
        widths: Distance between the pads at every command of :data:`COMMANDS`, metres, descending.
        reaches: How far the pads' ends are before the flange, metres: closing, they swing forward.
        joints: The fingers' joints, for checks of collisions.
    """

    widths: Float[np.ndarray, "commands"]
    reaches: Float[np.ndarray, "commands"]
    joints: Float[np.ndarray, "commands 8"]

    @property
    def widest(self) -> float:
        """Largest distance between the pads, metres."""
        return float(self.widths[0])

    def command(self, width: float) -> float:
        """Return the command that opens the pads to a width, metres."""
        return float(np.interp(-width, -self.widths, COMMANDS))

    def reach(self, width: float) -> float:
        """Return how far the pads' ends are before the flange at a width, metres."""
        return float(np.interp(-width, -self.widths, self.reaches))

    def fingers(self, width: float) -> Float[np.ndarray, "8"]:
        """Return the fingers' joints at a width, metres."""
        command = self.command(width)
        return np.array([np.interp(command, COMMANDS, one) for one in self.joints.T])


def measure_gripper() -> Gripper:
    """Drive the fingers from open to closed in free air and look where the pads are."""
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
