"""What a hand-eye calibration is worth, and what would make it better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dopepp.geometry.rotation import Vector
from dopepp.robot.calibration.hand_eye import (
    BoardPose,
    HandEye,
    Transforms,
    equations,
    pairs,
    refined,
)
from dopepp.robot.calibration.tool import named

MIN_POSES: Final = 8

MIN_DIVERSITY: Final = np.radians(15.0)
"""Of turns about the second most common axis, RMS over pairs."""

MAX_ERROR: Final = 0.003
"""Of a part at the board's distance, metres, one standard deviation."""

MAX_TURN: Final = np.radians(0.5)

MIN_USED: Final = 0.7
"""Share of the poses that agree with each other."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """What a calibration is worth.

    Attributes:
        shift: Expected error (one standard deviation) of what is seen at the board's distance,
            metres, and
        turn: of its rotation, radians.
        leave_one_out: By how much the camera's place changes without each pose, metres.
        diversity: RMS turn over pairs of poses about the three main axes, radians, descending.
        weakest: Axis of the camera's mount along which its place is known least.
        next_pose: What to add, in words.
        findings: Why it is not to be trusted, and what to do; empty where it is.
    """

    shift: float
    turn: float
    leave_one_out: Float[np.ndarray, "poses"]
    diversity: Vector
    weakest: Vector
    next_pose: str
    findings: tuple[str, ...]


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
    left_out = _left_out(T_base_flange, boards, calibration)
    mount = "flange" if calibration.mount == "hand" else "base"
    next_pose = (
        f"turn the flange by 30° or more about an axis across the {mount}'s {named(weakest)}"
    )
    findings = _findings(calibration, boards, diversity, shift, turn, next_pose)
    return Explanation(shift, turn, left_out, diversity, weakest, next_pose, findings)


def expected_error(covariance: Float[np.ndarray, "6 6"], distance: float) -> tuple[float, float]:
    """Return the standard deviations of a point's place (metres) and of a turn (radians).

    The point is ``distance`` metres before the camera; the covariance is :class:`HandEye`'s.
    """
    across = np.array([[0, distance, 0], [-distance, 0, 0], [0, 0, 0]])
    carry = np.hstack([across, np.eye(3)])
    place = carry @ covariance @ carry.T
    return float(np.sqrt(np.trace(place))), float(np.sqrt(np.trace(covariance[:3, :3])))


def _left_out(
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


def _findings(
    calibration: HandEye,
    boards: Sequence[BoardPose],
    diversity: Vector,
    shift: float,
    turn: float,
    next_pose: str,
) -> tuple[str, ...]:
    found = []
    used = int(calibration.inliers.sum())
    if used < MIN_POSES:
        found.append(f"only {used} poses: take at least {MIN_POSES}, better 15")
    if used < MIN_USED * len(boards):
        names = [
            one.name for one, used in zip(boards, calibration.inliers, strict=True) if not used
        ]
        found.append(
            f"{len(names)} of {len(boards)} poses contradict the others: {', '.join(names)}"
        )
    if diversity[1] < MIN_DIVERSITY:
        found.append(f"the robot turned about almost one direction only: {next_pose}")
    if shift > MAX_ERROR or turn > MAX_TURN:
        found.append(
            f"expected error {1000 * shift:.1f} mm and {np.degrees(turn):.2f}° at the board's "
            f"distance: {next_pose}"
        )
    return tuple(found)
