"""Whether to trust robot poses before a hand-eye calibration, and what the calibration is worth.

A motion turns robot and camera by the same angle, whatever the mounting is; so every way to read
the file can be held against the pictures, before anything is calibrated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.rotation import Vector
from dopepp.robot.calibration.board import BoardPose, Transforms
from dopepp.robot.calibration.files import UNITS, Reading, RobotPoses
from dopepp.robot.calibration.hand_eye import (
    HandEye,
    Mount,
    equations,
    inverted,
    nearest_rotation,
    pairs,
    refined,
)
from dopepp.robot.calibration.tool import named

MIN_TURN: Final = np.radians(5.0)  # between the two poses that are farthest from each other
TURN: Final = np.radians(1.5)  # median disagreement of pairs' turns below which a reading is right
SHIFT: Final = 0.01  # the same of shifts, metres
MOUNTS: Final[tuple[Mount, Mount]] = ("hand", "bench")
SCALE: Final = 1.03  # factor between robot's and camera's lengths that is none
MIN_POSES: Final = 8

MIN_DIVERSITY: Final = np.radians(15.0)
"""Of turns about the second most common axis, RMS over pairs."""

MAX_ERROR: Final = 0.003  # of a part at the board's distance, metres, one standard deviation
MAX_TURN: Final = np.radians(0.5)
MIN_USED: Final = 0.7  # share of the poses that agree with each other


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


@dataclass(frozen=True, eq=False)
class Explanation:
    """What a calibration is worth."""

    # Expected error (one standard deviation) of what is seen at the board's distance, metres.
    shift: float
    turn: float  # of its rotation, radians
    # By how much the camera's place changes without each pose, metres.
    leave_one_out: Float[np.ndarray, "poses"]
    diversity: Vector  # RMS turn over pairs of poses about the three main axes, radians, descending
    weakest: Vector  # axis of the camera's mount along which its place is known least
    next_pose: str  # what to add, in words
    findings: tuple[str, ...]  # why it is not to be trusted, and what to do; empty where it is


def explain(
    T_base_flange: Transforms, boards: Sequence[BoardPose], calibration: HandEye
) -> Explanation:
    """Say what a calibration is worth; the arguments are what it was made of."""
    M, B, _ = equations(T_base_flange, boards, calibration.mount)
    alpha = Rotation.from_matrix(pairs(M, B)[0][:, :3, :3]).as_rotvec()
    diversity = np.linalg.svd(alpha, compute_uv=False) / np.sqrt(len(alpha))
    distance = float(np.median([one.distance for one in boards]))
    shift, turn = expected_error(calibration.covariance, distance)
    to_mount = calibration.T_mount_cam[:3, :3]
    place = to_mount @ calibration.covariance[3:, 3:] @ to_mount.T
    weakest = np.linalg.eigh(place)[1][:, -1]
    mount = "flange" if calibration.mount == "hand" else "base"
    next_pose = (
        f"turn the flange by 30° or more about an axis across the {mount}'s {named(weakest)}"
    )
    findings = []
    left_out = [
        board.name for board, used in zip(boards, calibration.inliers, strict=True) if not used
    ]
    num_used = len(boards) - len(left_out)
    if num_used < MIN_POSES:
        findings.append(f"only {num_used} poses: take at least {MIN_POSES}, better 15")
    if num_used < MIN_USED * len(boards):
        contradicting = f"{len(left_out)} of {len(boards)} poses contradict the others"
        findings.append(f"{contradicting}: {', '.join(left_out)}")
    if diversity[1] < MIN_DIVERSITY:
        findings.append(f"the robot turned about almost one direction only: {next_pose}")
    if shift > MAX_ERROR or turn > MAX_TURN:
        findings.append(
            f"expected error {1000 * shift:.1f} mm and {np.degrees(turn):.2f}° at the board's "
            f"distance: {next_pose}"
        )
    moves = _moves_without(T_base_flange, boards, calibration)
    return Explanation(shift, turn, moves, diversity, weakest, next_pose, tuple(findings))


def expected_error(covariance: Float[np.ndarray, "6 6"], distance: float) -> tuple[float, float]:
    """Return the standard deviations of a point's place (metres) and of a turn (radians).

    The point is ``distance`` metres before the camera; the covariance is :class:`HandEye`'s.
    """
    across = np.array([[0, distance, 0], [-distance, 0, 0], [0, 0, 0]])
    carry = np.hstack([across, np.eye(3)])
    place = carry @ covariance @ carry.T
    return float(np.sqrt(np.trace(place))), float(np.sqrt(np.trace(covariance[:3, :3])))


def _moves_without(
    T: Transforms, boards: Sequence[BoardPose], calibration: HandEye
) -> Float[np.ndarray, "poses"]:
    """Return by how much the camera moves without each pose, metres; 0 for those not used."""
    moves = np.zeros(len(boards))
    X, Y = calibration.T_mount_cam, calibration.T_other_board
    M, B, seen = equations(T, boards, calibration.mount)
    used = np.flatnonzero(calibration.inliers)
    for one in used.tolist():
        rest = used[used != one]
        without, _, _ = refined(
            M[rest], B[rest], seen[rest], X, Y, np.array(calibration.robot_noise)
        )
        moves[one] = np.linalg.norm(without[:3, 3] - X[:3, 3])
    return moves
