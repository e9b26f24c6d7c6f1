"""What is usually wrong with robot poses, found by their consistency with what the camera saw.

A motion turns robot and camera by the same angle, whatever the mounting is; so every way to read
the file can be held against the pictures, before anything is calibrated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.robot.calibration.hand_eye import (
    BoardPose,
    Mount,
    Transforms,
    inverted,
    nearest_rotation,
    pairs,
)
from dopepp.robot.calibration.robot_poses import UNITS, Reading, RobotPoses

MIN_TURN: Final = np.radians(5.0)
"""Between the two poses that are farthest from each other."""

TURN: Final = np.radians(1.5)
"""Median disagreement of pairs' turns below which a reading is right."""

SHIFT: Final = 0.01
"""The same of shifts, metres."""

MOUNTS: Final[tuple[Mount, Mount]] = ("hand", "bench")

SCALE: Final = 1.03
"""Factor between robot's and camera's lengths that is none."""


@dataclass(frozen=True)
class Consistency:
    """How well motions of robot and board agree.

    ``turn`` (radians) and ``shift`` (metres) are medians over pairs; ``scale`` is the factor that
    the robot's lengths have to take.
    """

    turn: float
    shift: float
    scale: float

    @property
    def is_rigid(self) -> bool:
        """Whether one mounting explains all motions, but for the lengths' unit."""
        return self.turn < TURN and self.shift < SHIFT

    @property
    def is_right(self) -> bool:
        """Whether one mounting explains all motions."""
        return self.is_rigid and 1 / SCALE < self.scale < SCALE


def consistency(M: Transforms, B: Transforms) -> Consistency:
    """Compare the motions of robot and board; see :mod:`.hand_eye` for M and B."""
    P, Q = pairs(M, B)
    alpha, beta = (Rotation.from_matrix(one[:, :3, :3]).as_rotvec() for one in (P, Q))
    weights = np.minimum(np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1)) < 3.0
    if weights.sum() < 3:
        weights[:] = True
    alpha, beta, P, Q = alpha[weights], beta[weights], P[weights], Q[weights]
    R = nearest_rotation(alpha.T @ beta)
    for _ in range(5):  # robust: far pairs count less
        error = np.linalg.norm(alpha - beta @ R.T, axis=1)
        weight = 1 / (1 + (error / max(np.median(error), 1e-6)) ** 2)
        R = nearest_rotation((weight[:, None] * alpha).T @ beta)
    turn = float(np.median(np.linalg.norm(alpha - beta @ R.T, axis=1)))
    system = np.concatenate([P[:, :3, :3] - np.eye(3), P[:, :3, 3:]], axis=2)
    target = Q[:, :3, 3] @ R.T
    weight = np.ones(len(P))
    for _ in range(8):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(
            (system * root[..., None]).reshape(-1, 4), (target * root).ravel(), rcond=None
        )[0]
        error = np.linalg.norm(system @ solution - target, axis=1)
        weight = 1 / (1 + (error / max(np.median(error), 1e-6)) ** 2)
    return Consistency(turn, float(np.median(error)), float(solution[3]))


def check_poses(
    poses: RobotPoses,
    chosen: Sequence[int],
    reading: Reading,
    boards: Sequence[BoardPose],
    mount: Mount,
) -> Transforms:
    """Return T_base_flange of the chosen poses, one a board, if they can be what they are said.

    Raises:
        UserError: The robot or the board did not move; or poses and pictures contradict each
            other, with the reading of the file that would be right where there is one.
    """
    B = np.stack([one.T_cam_board for one in boards])
    own = poses.transforms(reading)[list(chosen)]
    _check_motion(B, "board, as the camera sees it,", poses.source)
    found = _consistency(own, B, mount)
    if found.is_right:
        return own
    if found.is_rigid:
        raise UserError(*_scaled(found.scale, reading.unit, poses.source))
    for other, words in _readings(poses, reading):
        for seat in MOUNTS if mount == "hand" else MOUNTS[::-1]:
            one = _consistency(poses.transforms(other)[list(chosen)], B, seat)
            if one.is_rigid and abs(one.scale) > 1e-6:
                raise _other(poses.source, words, seat == mount, one.scale, other.unit)
    _check_motion(own, "robot", poses.source)
    if len(chosen) > 5:
        for step in (1, -1):
            rows, seen = (own[:-1], B[1:]) if step == 1 else (own[1:], B[:-1])
            if _consistency(rows, seen, mount).is_right:
                raise UserError(
                    f"{poses.source}: poses fit the {'next' if step == 1 else 'last'} picture",
                    "the pose of every picture beside it", "shift the list by one, or add names",
                )  # fmt: skip
    raise UserError(
        f"{poses.source}: turns of robot and camera differ by {np.degrees(found.turn):.1f}° and "
        f"{1000 * found.shift:.0f} mm (medians of pairs)",
        f"{np.degrees(TURN):g}° and {1000 * SHIFT:g} mm",
        "check that every pose was recorded with its picture, after the robot had come to rest, "
        "and is the flange's (not a tool's that was changed in between)",
    )


def _check_motion(T: Transforms, what: str, source: str) -> None:
    """Refuse poses among which nothing turns."""
    i, j = np.triu_indices(len(T), 1)
    between = T[i, :3, :3] @ T[j, :3, :3].transpose(0, 2, 1)
    largest = Rotation.from_matrix(between).magnitude().max(initial=0.0)
    if largest < MIN_TURN:
        raise UserError(
            f"{source}: the {what} turns by {np.degrees(largest):.1f}° in all {len(T)} poses",
            "turns of 30° and more about different axes",
            "record the poses while the robot moves between pictures",
        )


def _consistency(T_base_flange: Transforms, B: Transforms, mount: Mount) -> Consistency:
    return consistency(T_base_flange if mount == "hand" else inverted(T_base_flange), B)


def _readings(poses: RobotPoses, reading: Reading) -> Iterator[tuple[Reading, str]]:
    """Yield other ways to read a file, with their words; the one as it is read first."""
    yield reading, ""
    if poses.kind == "quaternion":
        last = reading.order == "wxyz"
        yield (
            replace(reading, order="xyzw" if last else "wxyz"),
            f"quaternions with w {'last' if last else 'first'}: --quaternion "
            f"{'xyzw' if last else 'wxyz'}",
        )
    elif poses.kind != "matrix":
        unit = "rad" if reading.degrees else "deg"
        yield replace(reading, degrees=not reading.degrees), f"--angles {unit}"


def _other(source: str, words: str, same: bool, scale: float, unit: str) -> UserError:
    """Return what is wrong where another reading is right."""
    said = [words] if words else []
    if not same:
        said.append(
            "poses from base to flange (--direction base-to-flange), or the camera on the other "
            "side (--mount)"
        )
    right = _unit(scale, unit)
    if right is None:
        said.append(f"lengths that are {scale:.4g} times the robot's")
    elif right != unit:
        said.append(f"--unit {right}")
    got = f"{source}, whose poses contradict the pictures as they are read"
    return UserError(got, "poses that fit: with " + ", and ".join(said), "pass that")


def _scaled(scale: float, unit: str, source: str) -> tuple[str, str, str]:
    """Return what is wrong where turns fit and lengths do not."""
    right = _unit(scale, unit)
    if right is not None:
        return (
            f"{source} in {unit}, which makes the robot's ways {1 / scale:.4g} times too long",
            f"--unit {right}", "pass that",
        )  # fmt: skip
    return (
        f"{source}: the robot's ways are {1 / scale:.3f} times those that the camera sees",
        f"a factor from {1 / SCALE:.2f} to {SCALE:.2f}",
        f"measure the board's squares: they would be {1 / scale:.3f} times as large as said, or "
        "calibrate the camera again",
    )


def _unit(scale: float, unit: str) -> str | None:
    """Return the unit that a factor on the lengths means."""
    for name, metres in UNITS.items():
        if 1 / SCALE < scale * UNITS[unit] / metres < SCALE:
            return name
    return None
