"""A tool's tip from poses that touch one point (pivot calibration), and a bench's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.rotation import Vector
from dopepp.robot.calibration.board import Board
from dopepp.robot.calibration.hand_eye import nearest_rotation

MIN_POSES: Final = 4

MAX_AMPLIFICATION: Final = 6.0
"""From a pose's error to the tip's: about 25° between the farthest poses."""

MAX_RESIDUAL: Final = 0.002  # metres: more is no point that was touched


@dataclass(frozen=True, eq=False)
class Tip:
    """A tool's tip."""

    position: Vector  # in the flange's frame, metres
    pivot: Vector  # the point that was touched, in the base's frame, metres
    residuals: Float[np.ndarray, "poses"]  # how far every pose's tip is from it, metres
    deviations: Vector  # standard deviations of the position along the flange's axes, metres
    amplification: float  # factor from the poses' errors to the tip's along the axis known least
    weakest: Vector  # that axis in the flange's frame, a unit vector
    findings: tuple[str, ...]  # why it is not to be trusted, and what to do; empty where it is


def find_tip(T_base_flange: Float[np.ndarray, "poses 4 4"]) -> Tip:
    """Find the tool's tip from poses of the flange in all of which it touches one point.

    R_i p + t_i = q for all i is linear in the tip p and the point q. A :class:`UserError`: there
    are fewer than four poses.
    """
    poses = np.asarray(T_base_flange, np.float64)
    if len(poses) < MIN_POSES:
        raise UserError(
            f"{len(poses)} poses", f"at least {MIN_POSES} that touch one point", "add further ones"
        )
    system = np.concatenate([np.hstack([one[:3, :3], -np.eye(3)]) for one in poses])
    target = -poses[:, :3, 3].ravel()
    solution, _, _, _ = np.linalg.lstsq(system, target, rcond=1e-6)
    residuals = (system @ solution - target).reshape(-1, 3)
    spread = np.sqrt((residuals**2).sum() / max(1, residuals.size - 6))
    covariance = np.linalg.pinv(system.T @ system, rcond=1e-12)[:3, :3]
    distances = np.linalg.norm(residuals, axis=1)
    # What a pose tells of the tip on average, once the point is solved for.
    mean = poses[:, :3, :3].mean(axis=0)
    values, axes = np.linalg.eigh(np.eye(3) - mean.T @ mean)
    amplification = float(1 / np.sqrt(values[0])) if values[0] > 1e-9 else np.inf
    weakest = axes[:, 0]
    return Tip(
        solution[:3], solution[3:], distances, spread * np.sqrt(np.diag(covariance)),
        amplification, weakest, _doubts(amplification, weakest, distances),
    )  # fmt: skip


def _doubts(
    amplification: float, weakest: Vector, residuals: Float[np.ndarray, "poses"]
) -> tuple[str, ...]:
    found = []
    if amplification > MAX_AMPLIFICATION:
        found.append(
            f"the tip is open along the flange's {named(weakest)}: turn the tool by 30° or more "
            f"about an axis across {named(weakest)} next"
        )
    worst = int(residuals.argmax())
    if residuals[worst] > MAX_RESIDUAL:
        found.append(
            f"pose {worst + 1} is {1000 * residuals[worst]:.1f} mm off: was the tip on the point, "
            "and are the poses those of the flange?"
        )
    return tuple(found)


@dataclass(frozen=True, eq=False)
class Bench:
    """A plane of the robot's cell and a frame on it."""

    # z away from the plane, towards the robot's side; origin at the first point, x towards the
    # second.
    T_base_bench: Transform
    # Distance of every point from the plane, metres, above positive.
    residuals: Float[np.ndarray, "points"]
    findings: tuple[str, ...]  # why it is not to be trusted, and what to do; empty where it is


def find_bench(touched: Float[np.ndarray, "points 3"], up: Vector | None = None) -> Bench:
    """Find the plane of points that the tip has touched, in the base's frame, metres.

    ``up`` is a direction that z must not oppose, the base's z where it is left out. A
    :class:`UserError`: there are fewer than three points, or they lie on a line.
    """
    points = np.asarray(touched, np.float64)
    if len(points) < 3:
        raise UserError(f"{len(points)} points", "at least 3, better 5 or more", "touch more")
    centre = points.mean(axis=0)
    values, axes = np.linalg.svd(points - centre, full_matrices=False)[1:]
    if values[1] < 0.1 * values[0]:
        raise UserError(
            "points along a line", "points all over the bench", "touch some beside the line"
        )
    z = axes[2] if axes[2] @ (np.array([0, 0, 1.0]) if up is None else up) >= 0 else -axes[2]
    origin = points[0] - (points[0] - centre) @ z * z
    x = points[1] - points[0]
    x = x - x @ z * z
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    residuals = (points - centre) @ z
    worst = int(np.abs(residuals).argmax())
    findings = []
    if len(points) == 3:
        findings.append("three points lie on every plane: touch two more, as a check")
    if abs(residuals[worst]) > MAX_RESIDUAL:
        findings.append(
            f"point {worst + 1} is {1000 * abs(residuals[worst]):.1f} mm off the plane: touch it "
            "again, or is the bench not flat?"
        )
    return Bench(make_transform(rotation, origin), residuals, tuple(findings))


def bench_of_board(T_base_board: Sequence[Transform], board: Board) -> Bench:
    """Return the bench under a board that lies on it, from where pictures show the board.

    z points out of the board, towards who sees it; origin and x are the board's. Residuals are how
    far, along z, the middle of each picture's board is from the mean. A :class:`UserError`: there
    is no picture.
    """
    if not len(T_base_board):
        raise UserError("no picture with a pose", "one or more", "add the robot's poses of them")
    poses, middle = np.stack(T_base_board), board.points.mean(axis=0)
    R = nearest_rotation(poses[:, :3, :3].sum(axis=0)) @ np.diag([1.0, -1.0, -1.0])
    seen = poses[:, :3, :3] @ middle + poses[:, :3, 3]
    away = seen - seen.mean(axis=0)
    at = seen.mean(axis=0) - R @ (np.array([1.0, -1.0, -1.0]) * middle)
    worst = int(np.linalg.norm(away, axis=1).argmax())
    far = float(np.linalg.norm(away[worst]))
    findings = []
    if len(poses) == 1:
        findings.append("one picture is no check: take two more, from elsewhere if the camera is "
                        "in the hand")  # fmt: skip
    if far > MAX_RESIDUAL:
        findings.append(
            f"picture {worst + 1} shows the board {1000 * far:.1f} mm from where the others do: "
            "was it moved, or is the hand-eye calibration of another setup?"
        )
    return Bench(make_transform(R, at), away @ R[:, 2], tuple(findings))


def named(axis: Vector) -> str:
    """Return an axis in words: the frame's own where it is within 15°, else its direction."""
    k = int(np.abs(axis).argmax())
    if abs(axis[k]) > 0.966:
        return "xyz"[k] + " axis"
    return "direction ({:.2f}, {:.2f}, {:.2f})".format(*axis)
