"""Execution of a grasp plan in the MuJoCo simulation, and its outcome."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float

from dopepp.robot.grasping.cell import JOINTS, STEP, Cell
from dopepp.robot.grasping.planner import Gripper, Joints, Path, Plan

SPEED: Final = 1.5  # average speed of the fastest joint over a motion, rad/s
CLOSING_S: Final = 0.5  # duration of the ramp of the gripper's command, seconds
CLOSED: Final = 255.0  # command for zero width: the fingers press on a part of any width
PAUSE_S: Final = 0.3
SHAKE_S: Final = 1.2
SHAKE_HZ: Final = 3.0
SHAKE: Final = np.radians([0.0, 0.0, 0.0, 7.0, 7.0, 12.0])  # amplitudes; accelerate by about 1 g
HELD_HEIGHT: Final = 0.05  # minimum rise of a part that counts as held, metres
HIT_FORCE: Final = 5.0  # minimum contact force of a collision before the fingers close, newtons
LAG_S: Final = 0.2  # delay of the servos (damping over stiffness), which commands compensate
FRAME_S: Final = 0.04  # interval of recorded states, seconds


@dataclass
class Outcome:
    """Result of the arm's motions: held solid, collisions and recorded states."""

    held: int | None = None  # index of the solid that was highest after lifting and shaking
    lifted: tuple[int, ...] = ()  # indices of all solids that the gripper held then
    collided: bool = False  # whether the robot hit bench or solid before the fingers closed
    times: list[float] = field(default_factory=list)  # time of each recorded state, seconds
    states: list[Float[np.ndarray, "positions"]] = field(default_factory=list)  # qpos of MuJoCo


class Execution:
    """Execution of the controller's motions in a MuJoCo ``state`` of the cell, which it modifies.

    ``zero`` are the true joint angles of the arm when its controller reads 0, radians.
    """

    def __init__(self, cell: Cell, state: Any, gripper: Gripper, zero: Joints) -> None:
        self._cell, self._state, self._gripper, self._zero = cell, state, gripper, zero
        self._command = float(state.ctrl[JOINTS])
        self.outcome = Outcome()

    def stand(self, joints: Joints) -> None:
        """Set the arm's pose without a motion; ``joints`` are the controller's angles, radians."""
        state = self._state
        state.qpos[:JOINTS] = state.ctrl[:JOINTS] = joints + self._zero
        state.qvel[: JOINTS + 8] = 0.0
        mujoco.mj_forward(self._cell.model, state)

    def wait(self, seconds: float) -> None:
        """Simulate for ``seconds`` with constant commands to the servos."""
        mujoco.mj_step(self._cell.model, self._state, nstep=round(seconds / STEP))

    def run(self, plan: Plan) -> Outcome:
        """Execute a plan: approach, close the fingers, lift and shake.

        A solid counts as lifted if it rises by more than 5 cm; the solid that rises most is held.
        """
        heights_before = self._heights()
        self._command = self._gripper.command(plan.opening)
        for path in (plan.approach, plan.descent):
            self.move(path)
        grasp_joints, opened = plan.descent[-1], self._command
        for share in np.linspace(0, 1, round(CLOSING_S / STEP)):
            self._command = (1 - share) * opened + share * CLOSED
            self._advance(grasp_joints, np.zeros(JOINTS))
        self._rest(grasp_joints)
        for joints in chain(_sample_path(plan.lift), _sample_shake(plan.lift[-1])):
            self._advance(*joints)
        self._rest(plan.lift[-1])
        rises = self._heights() - heights_before
        self.outcome.lifted = tuple(np.flatnonzero(rises > HELD_HEIGHT).tolist())
        if self.outcome.lifted:
            self.outcome.held = int(rises.argmax())
        return self.outcome

    def move(self, path: Path) -> None:
        """Move the arm along a path of joint angles, from rest to rest, and record collisions."""
        for joints in _sample_path(path):
            self._advance(*joints)
            self.outcome.collided |= self._is_hit()

    def _heights(self) -> Float[np.ndarray, "solids"]:
        """Return the height of each solid's origin above the bench, metres."""
        cell, state = self._cell, self._state
        return np.array([cell.pose(state, number)[2, 3] for number in range(cell.count)])

    def _rest(self, joints: Joints) -> None:
        """Hold the arm at joint angles for :data:`PAUSE_S` seconds."""
        for _ in range(round(PAUSE_S / STEP)):
            self._advance(joints, np.zeros(JOINTS))

    def _advance(self, joints: Joints, speeds: Joints) -> None:
        """Simulate a step towards joint angles (radians) and speeds (rad/s); record the state."""
        state = self._state
        state.ctrl[:JOINTS] = joints + self._zero + LAG_S * speeds
        state.ctrl[JOINTS] = self._command
        mujoco.mj_step(self._cell.model, state)
        times = self.outcome.times
        if not times or state.time - times[-1] >= FRAME_S - STEP / 2:
            times.append(float(state.time))
            self.outcome.states.append(state.qpos.copy())

    def _is_hit(self) -> bool:
        """Return whether the robot presses on bench or solid with more than 5 N (`HIT_FORCE`)."""
        state, force = self._state, np.zeros(6)
        pairs = self._cell.groups[state.contact.geom]
        for number in np.flatnonzero((pairs == 0).sum(axis=1) == 1):
            mujoco.mj_contactForce(self._cell.model, state, int(number), force)
            if np.linalg.norm(force[:3]) > HIT_FORCE:
                return True
        return False


def _sample_path(path: Path) -> Iterator[tuple[Joints, Joints]]:
    """Yield joint angles and speeds along a path at each time step, from rest to rest."""
    lengths = np.abs(np.diff(path, axis=0)).max(axis=1)
    distances = np.concatenate([[0.0], np.cumsum(lengths)])
    count = round(max(float(distances[-1]) / SPEED, 0.4) / STEP)
    share = np.linspace(0, 1, count + 1)[1:]
    smooth = share**3 * (10 - 15 * share + 6 * share**2) * distances[-1]  # minimum jerk
    joints = np.stack([np.interp(smooth, distances, joint) for joint in path.T], axis=1)
    speeds = np.gradient(joints, STEP, axis=0)
    yield from zip(joints, speeds, strict=True)


def _sample_shake(joints: Joints) -> Iterator[tuple[Joints, Joints]]:
    """Yield angles and speeds, at each time step, of an oscillation around ``joints``."""
    times = np.arange(0, SHAKE_S, STEP)
    fade = np.sin(np.pi * times / SHAKE_S) ** 0.5
    swings = (fade * np.sin(2 * np.pi * SHAKE_HZ * times))[:, None] * SHAKE
    speeds = np.gradient(swings, STEP, axis=0)
    yield from zip(joints + swings, speeds, strict=True)
