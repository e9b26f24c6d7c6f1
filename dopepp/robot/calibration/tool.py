"""Calibration of a tool's tip (pivot calibration) and of a bench's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.refine import covariance_of
from dopepp.geometry.rotation import Vector, nearest_rotation
from dopepp.robot.calibration.board import Board

MIN_POSES: Final = 4
MAX_AMPLIFICATION: Final = 6.0  # of a pose's error in the tip: 25° between the farthest poses
MIN_SPREAD: Final = 1e-6  # smallest assumed deviation of a touched point, metres
MAX_RESIDUAL: Final = 0.002  # largest distance of a touched point from the fit, metres


@dataclass(frozen=True, eq=False)
class Tip:
    """Position of a tool's tip in the flange's frame, and its errors, metres."""

    position: Vector
    residuals: Float[np.ndarray, "poses"]  # distance of the tip from the fixed point
    deviations: Vector  # standard deviations along the flange's axes
    findings: tuple[str, ...]  # reasons not to trust the tip, with remedies


def find_tip(T_base_flange: Float[np.ndarray, "poses 4 4"]) -> Tip:
    """Estimate the position of a tool's tip from poses in which the tip touches a fixed point.

    The tip p (flange frame) and the point q (base frame) solve R_i p + t_i = q for all poses
    T_base_flange = (R_i, t_i), metres.

    Raises:
        UserError: There are fewer than four poses.
    """
    poses = np.asarray(T_base_flange, np.float64)
    if len(poses) < MIN_POSES:
        allowed = f"at least {MIN_POSES} that touch one point"
        fix = "record more poses in which the tip touches the point"
        raise UserError(f"{len(poses)} poses", allowed, fix)
    system = np.concatenate([np.hstack([pose[:3, :3], -np.eye(3)]) for pose in poses])
    target = -poses[:, :3, 3].ravel()
    solution, _, _, _ = np.linalg.lstsq(system, target, rcond=1e-6)
    residuals = (system @ solution - target).reshape(-1, 3)
    spread = np.sqrt((residuals**2).sum() / max(1, residuals.size - 6))
    covariance = covariance_of(system.T @ system / max(spread, MIN_SPREAD) ** 2)
    deviations = np.sqrt(np.diag(covariance)[:3])
    distances = np.linalg.norm(residuals, axis=1)
    # Mean information of a pose about the tip, after elimination of the point.
    mean = poses[:, :3, :3].mean(axis=0)
    values, axes = np.linalg.eigh(np.eye(3) - mean.T @ mean)
    amplification = float(1 / np.sqrt(values[0])) if values[0] > 1e-9 else np.inf
    findings = []
    if amplification > MAX_AMPLIFICATION:
        axis = axis_name(axes[:, 0])
        findings.append(
            f"the tip is uncertain along the flange's {axis}: add poses with the tool rotated by "
            f"30° or more about an axis across {axis}"
        )
    worst = int(distances.argmax())
    if distances[worst] > MAX_RESIDUAL:
        findings.append(
            f"pose {worst + 1} is {1000 * distances[worst]:.1f} mm off: check that the tip touched "
            "the point, and that the poses are flange poses"
        )
    return Tip(solution[:3], distances, deviations, tuple(findings))


@dataclass(frozen=True, eq=False)
class Bench:
    """Frame of a bench in the robot's base frame, with z normal to the bench, and its errors."""

    T_base_bench: Transform  # of touched points: origin at the first point, x to the second point
    residuals: Float[np.ndarray, "points"]  # signed distances of points from the plane, metres
    findings: tuple[str, ...]  # reasons not to trust the plane, with remedies


def find_bench(touched: Float[np.ndarray, "points 3"]) -> Bench:
    """Fit a plane, with z upwards, to touched points in the robot's base frame, metres.

    Raises:
        UserError: There are fewer than three points, they almost lie on a line, or the first two
            almost coincide.
    """
    points = np.asarray(touched, np.float64)
    if len(points) < 3:
        fix = "touch more points of the bench and add them to the file"
        raise UserError(f"{len(points)} points", "at least 3, better 5 or more", fix)
    centre = points.mean(axis=0)
    values, axes = np.linalg.svd(points - centre, full_matrices=False)[1:]
    if values[1] < 0.1 * values[0]:
        allowed, fix = "points all over the bench", "touch more points, away from the line"
        raise UserError("points along a line", allowed, fix)
    if np.linalg.norm(points[1] - points[0]) < MAX_RESIDUAL:
        allowed, fix = "a far point, which defines x", "move a far point to the second line"
        raise UserError("the second point next to the first point", allowed, fix)
    z = axes[2] if axes[2, 2] >= 0 else -axes[2]
    origin = points[0] - (points[0] - centre) @ z * z
    x = points[1] - points[0]
    x = x - x @ z * z
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    residuals = (points - centre) @ z
    worst = int(np.abs(residuals).argmax())
    findings = []
    if len(points) == 3:
        findings.append("three points always lie on a plane: touch two more as a check")
    if abs(residuals[worst]) > MAX_RESIDUAL:
        findings.append(
            f"point {worst + 1} is {1000 * abs(residuals[worst]):.1f} mm off the plane: touch it "
            "again, and check that the bench is flat"
        )
    return Bench(make_transform(rotation, origin), residuals, tuple(findings))


def bench_of_board(T_base_board: Sequence[Transform], board: Board) -> Bench:
    """Estimate the frame of the bench from the pose in each image of a board that lies on it.

    The bench frame has the board's origin and x axis; its z axis points out of the board. A
    residual is the distance along z between the board's centre in an image and the mean of all
    images.

    Raises:
        UserError: There is no pose.
    """
    if not len(T_base_board):
        fix = "record the robot's pose at every image"
        raise UserError("no image with a robot pose", "at least one image with a robot pose", fix)
    poses, middle = np.stack(T_base_board), board.points.mean(axis=0)
    R = nearest_rotation(poses[:, :3, :3].sum(axis=0)) @ np.diag([1.0, -1.0, -1.0])
    centres = poses[:, :3, :3] @ middle + poses[:, :3, 3]
    offsets = centres - centres.mean(axis=0)
    origin = centres.mean(axis=0) - R @ (np.array([1.0, -1.0, -1.0]) * middle)
    distances = np.linalg.norm(offsets, axis=1)
    worst = int(distances.argmax())
    findings = []
    if len(poses) == 1:
        findings.append(
            "a single image cannot be verified: take two more, from other poses if the camera is "
            "on the flange"
        )
    if distances[worst] > MAX_RESIDUAL:
        findings.append(
            f"image {worst + 1} shows the board {1000 * distances[worst]:.1f} mm from its mean "
            "position: check that it was not moved, and that the hand-eye calibration is current"
        )
    return Bench(make_transform(R, origin), offsets @ R[:, 2], tuple(findings))


def axis_name(direction: Vector) -> str:
    """Return the name of the axis within 15° of ±``direction`` (unit vector), or its numbers."""
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) > 0.966:
        return "xyz"[k] + " axis"
    return "direction ({:.2f}, {:.2f}, {:.2f})".format(*direction)
