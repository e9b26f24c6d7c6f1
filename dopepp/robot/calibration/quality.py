"""Checks of robot poses before a hand-eye calibration, and the quality of its result.

A motion rotates robot and camera by equal angles, for any mount of the camera. Therefore, poses of
the robot can be compared with images before the calibration, under every pose convention.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.rotation import Vector, nearest_rotation
from dopepp.parts.part import UNITS
from dopepp.robot.calibration.board import BoardPose, Transforms
from dopepp.robot.calibration.hand_eye import (
    MOUNTS,
    HandEye,
    Mount,
    refine,
    relative_motions,
    robot_world_equations,
)
from dopepp.robot.calibration.records import PoseFormat, RobotPoses
from dopepp.robot.calibration.tool import axis_name

MIN_ROTATION: Final = np.radians(5.0)  # smallest valid maximum of the rotations between two poses
# Largest median errors over pairs under the correct convention, radians and metres.
MAX_ROTATION_ERROR, MAX_SHIFT_ERROR = np.radians(1.5), 0.01
SCALE: Final = 1.03  # largest negligible factor between the robot's and the camera's lengths
# Mean error of a fit with equal lengths, as a multiple of that with free lengths and in metres,
# up to which both fits are equally good.
SAME_FIT, SMALLEST_SHIFT = 1.2, 1e-4
MIN_POSES: Final = 8
MIN_DIVERSITY: Final = np.radians(15.0)  # RMS rotation over pairs about the second main axis
MAX_ERROR: Final = 0.003  # largest standard deviation at the board's distance, metres
MAX_ROTATION: Final = np.radians(0.5)  # largest standard deviation of the rotation
MIN_USED: Final = 0.7  # share of poses that agree with each other


@dataclass(frozen=True)
class MotionAgreement:
    """Errors of P X = X Q for the motions P of the robot and Q of the board between two images.

    X is the camera's pose on its mount that fits all pairs of images best.
    """

    rotation: float  # median rotation error over pairs, radians
    shift: float  # median translation error over pairs after correction by ``scale``, metres
    scale: float  # factor by which the robot's lengths must be multiplied to fit the board's

    @property
    def is_rigid(self) -> bool:
        """Whether the median errors are below 1.5° and 10 mm."""
        return self.rotation < MAX_ROTATION_ERROR and self.shift < MAX_SHIFT_ERROR

    @property
    def is_consistent(self) -> bool:
        """Whether :attr:`is_rigid` holds and ``scale`` differs from 1 by at most about 3 %."""
        return self.is_rigid and 1 / SCALE < self.scale < SCALE


def compare_motions(T_base_flange: Transforms, B: Transforms, mount: Mount) -> MotionAgreement:
    """Compare the motions of the flange and of the board (B = T_cam_board) between all images."""
    M = T_base_flange if mount == "hand" else np.linalg.inv(T_base_flange)
    P, Q = relative_motions(M, B)
    alpha, beta = (Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in (P, Q))
    used = np.minimum(np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1)) < 3.0
    if used.sum() < 3:
        used[:] = True
    alpha, beta, P, Q = alpha[used], beta[used], P[used], Q[used]
    R = nearest_rotation(alpha.T @ beta)
    for _ in range(5):
        weights = _robust_weights(np.linalg.norm(alpha - beta @ R.T, axis=1))
        R = nearest_rotation((weights[:, None] * alpha).T @ beta)
    rotation = float(np.median(np.linalg.norm(alpha - beta @ R.T, axis=1)))
    turns, shifts, target = P[:, :3, :3] - np.eye(3), P[:, :3, 3:], Q[:, :3, 3] @ R.T
    _, unscaled = _fit_shift(turns, target - shifts[..., 0])
    solution, scaled = _fit_shift(np.concatenate([turns, shifts], axis=2), target)
    # A flange that only rotates about its origin does not determine the scale.
    weights = _robust_weights(scaled)
    errors = [float(np.average(lengths, weights=weights)) for lengths in (unscaled, scaled)]
    if errors[0] < max(SAME_FIT * errors[1], SMALLEST_SHIFT):
        return MotionAgreement(rotation, float(np.median(unscaled)), 1.0)
    return MotionAgreement(rotation, float(np.median(scaled)), float(solution[3]))


def _fit_shift(
    system: Float[np.ndarray, "pairs 3 unknowns"], target: Float[np.ndarray, "pairs 3"]
) -> tuple[Float[np.ndarray, "unknowns"], Float[np.ndarray, "pairs"]]:
    """Solve a linear system by robust least squares; return the solution and each pair's error."""
    weights = np.ones(len(target))
    for _ in range(8):
        root = np.sqrt(weights)[:, None]
        weighted = (system * root[..., None]).reshape(target.size, -1)
        solution = np.linalg.lstsq(weighted, (target * root).ravel(), rcond=None)[0]
        errors = np.linalg.norm(system @ solution - target, axis=1)
        weights = _robust_weights(errors)
    return solution, errors


def _robust_weights(errors: Float[np.ndarray, "pairs"]) -> Float[np.ndarray, "pairs"]:
    """Return the Cauchy weight 1 / (1 + (error / median)²) of each error."""
    return np.asarray(1 / (1 + (errors / max(np.median(errors), 1e-6)) ** 2))


def check_poses(
    poses: RobotPoses,
    chosen: Sequence[int],
    pose_format: PoseFormat,
    boards: Sequence[BoardPose],
    mount: Mount,
) -> Transforms:
    """Check that the robot's motions agree with the board's motions in the images.

    ``chosen`` has an index into ``poses`` for each entry of ``boards``.

    Returns:
        T_base_flange of the chosen poses, metres.

    Raises:
        UserError: There is no pose, the robot or the board rotates by less than 5° between any two
            poses, or their motions disagree. The message names conventions under which they agree,
            if any.
    """
    if not boards:
        problem = f"{poses.source}: no pose has an image that shows the board"
        fix = "compare the names in the file with those of the images"
        raise UserError(problem, "poses of images that show the board", fix)
    B = np.stack([board.T_cam_board for board in boards])
    flanges = poses.transforms(pose_format)[list(chosen)]
    _check_motion(B, "board, seen by the camera,", poses.source)
    agreement = compare_motions(flanges, B, mount)
    if agreement.is_consistent:
        return flanges
    if agreement.is_rigid:
        raise _scale_error(agreement.scale, pose_format.unit, poses.source)
    for other, advice in _other_formats(poses, pose_format):
        for other_mount in MOUNTS if mount == "hand" else MOUNTS[::-1]:
            fit = compare_motions(poses.transforms(other)[list(chosen)], B, other_mount)
            if fit.is_rigid and abs(fit.scale) > 1e-6:
                raise _format_error(poses.source, advice, other_mount == mount, fit.scale, other)
    _check_motion(flanges, "robot", poses.source)
    if len(chosen) > 5:
        shifted = ("next", flanges[:-1], B[1:]), ("previous", flanges[1:], B[:-1])
        for neighbour, shifted_flanges, shifted_boards in shifted:
            if compare_motions(shifted_flanges, shifted_boards, mount).is_consistent:
                problem = f"{poses.source}: the poses fit the {neighbour} image"
                fix = "shift the list of poses by one, or name each pose's image in a column `name`"
                raise UserError(problem, "poses in the order of the images", fix)
    raise UserError(
        f"{poses.source}: rotations of robot and camera differ by "
        f"{np.degrees(agreement.rotation):.1f}° and {1000 * agreement.shift:.0f} mm (medians over "
        "pairs)",
        f"at most {np.degrees(MAX_ROTATION_ERROR):g}° and {1000 * MAX_SHIFT_ERROR:g} mm",
        "record every pose with its image, after the robot has come to rest, and record the "
        "pose of the flange, not of a tool",
    )


def _check_motion(T: Transforms, body: str, source: str) -> None:
    """Check that a body rotates by at least :data:`MIN_ROTATION` between two of its poses."""
    i, j = np.triu_indices(len(T), 1)
    relative = T[i, :3, :3] @ T[j, :3, :3].transpose(0, 2, 1)
    largest = Rotation.from_matrix(relative).magnitude().max(initial=0.0)
    if largest < MIN_ROTATION:
        raise UserError(
            f"{source}: the {body} rotates by {np.degrees(largest):.1f}° over all {len(T)} poses",
            "rotations of at least 30° about different axes",
            "rotate the robot between images, and record each image's pose",
        )


def _other_formats(poses: RobotPoses, pose_format: PoseFormat) -> Iterator[tuple[PoseFormat, str]]:
    """Yield ``pose_format`` and its other angle unit or quaternion order, with the CLI option."""
    yield pose_format, ""
    if poses.kind == "quaternion":
        order, position = ("xyzw", "last") if pose_format.order == "wxyz" else ("wxyz", "first")
        advice = f"quaternions with w {position}: --quaternion {order}"
        yield replace(pose_format, order=order), advice
    elif poses.kind != "matrix":
        unit = "rad" if pose_format.degrees else "deg"
        yield replace(pose_format, degrees=not pose_format.degrees), f"--angles {unit}"


def _format_error(
    source: str, advice: str, same_mount: bool, scale: float, pose_format: PoseFormat
) -> UserError:
    """Return the error that names the conventions under which robot poses fit the images."""
    changes = [advice] if advice else []
    if not same_mount:
        direction = "flange-to-base" if pose_format.inverted else "base-to-flange"
        changes.append(f"--direction {direction}, or the camera on the other mount (--mount)")
    unit = _unit_of(scale, pose_format.unit)
    if unit is None:
        changes.append(f"lengths of {scale:.4g} times the robot's")
    elif unit != pose_format.unit:
        changes.append(f"--unit {unit}")
    problem = f"{source}, whose poses contradict the images"
    allowed = f"poses that fit, such as {', and '.join(changes)}"
    return UserError(problem, allowed, "run the command again with these options")


def _scale_error(scale: float, unit: str, source: str) -> UserError:
    """Return the error for robot positions in ``unit`` that should be ``scale`` times as large."""
    factor, right = 1 / scale, _unit_of(scale, unit)
    if right is not None:
        problem = f"{source} in {unit}, which makes the robot's motions {factor:.4g} times too long"
        return UserError(problem, f"--unit {right}", f"run the command again with --unit {right}")
    return UserError(
        f"{source}: the robot's motions are {factor:.3f} times the camera's motions",
        f"a factor from {1 / SCALE:.2f} to {SCALE:.2f}",
        f"measure the board's squares (they may be {factor:.3f} times as large as stated), or "
        "calibrate the camera again",
    )


def _unit_of(scale: float, unit: str) -> str | None:
    """Return the length unit that is ``scale`` times ``unit`` within 3 %, or None."""
    for name, metres in UNITS.items():
        if 1 / SCALE < scale * UNITS[unit] / metres < SCALE:
            return name
    return None


@dataclass(frozen=True, eq=False)
class CalibrationQuality:
    """Quality of a hand-eye calibration: expected errors, variety of the motions, and advice."""

    shift: float  # expected error of positions at the board's distance (1 σ), metres
    rotation: float  # expected error of the camera's rotation (1 σ), radians
    leave_one_out: Float[np.ndarray, "poses"]  # motion of the camera without each pose, metres
    diversity: Vector  # RMS rotation over pairs about the 3 principal axes, radians, descending
    next_pose: str  # advice on the rotation that reduces the largest position variance
    findings: tuple[str, ...]  # reasons not to trust the calibration, with remedies


def assess(
    T_base_flange: Transforms, boards: Sequence[BoardPose], calibration: HandEye
) -> CalibrationQuality:
    """Assess a hand-eye calibration from its result and the poses it was estimated from."""
    M, B, B_cov = robot_world_equations(T_base_flange, boards, calibration.mount)
    alpha = Rotation.from_matrix(relative_motions(M, B)[0][:, :3, :3]).as_rotvec()
    diversity = np.linalg.svd(alpha, compute_uv=False) / np.sqrt(len(alpha))
    distance = float(np.median([board.distance for board in boards]))
    shift, rotation = expected_error(calibration.covariance, distance)
    X, Y, used = calibration.T_mount_cam, calibration.T_other_board, calibration.inliers
    weakest = np.linalg.eigh(X[:3, :3] @ calibration.covariance[3:, 3:] @ X[:3, :3].T)[1][:, -1]
    mount = "flange" if calibration.mount == "hand" else "base"
    axis = axis_name(weakest)
    next_pose = f"rotate the flange by 30° or more about an axis across the {mount}'s {axis}"
    rejected = [board.name for board, is_used in zip(boards, used, strict=True) if not is_used]
    num_used = len(boards) - len(rejected)
    findings = {
        f"only {num_used} poses: take at least {MIN_POSES}, better 15": num_used < MIN_POSES,
        f"{len(rejected)} of {len(boards)} poses contradict the others: {', '.join(rejected)}": (
            num_used < MIN_USED * len(boards)
        ),
        f"the robot rotated about nearly parallel axes only: {next_pose}": (
            diversity[1] < MIN_DIVERSITY
        ),
        f"expected error {1000 * shift:.1f} mm and {np.degrees(rotation):.2f}° at the board's "
        f"distance: {next_pose}": shift > MAX_ERROR or rotation > MAX_ROTATION,
    }
    changes = np.zeros(len(boards))
    indices = np.flatnonzero(used)
    for index in indices.tolist():
        rest = indices[indices != index]
        noise = np.array(calibration.robot_noise)
        without, _, _ = refine(M[rest], B[rest], B_cov[rest], X, Y, noise, calibration.mount)
        changes[index] = np.linalg.norm(without[:3, 3] - X[:3, 3])
    reasons = tuple(text for text, applies in findings.items() if applies)
    return CalibrationQuality(shift, rotation, changes, diversity, next_pose, reasons)


def expected_error(covariance: Float[np.ndarray, "6 6"], distance: float) -> tuple[float, float]:
    """Return standard deviations, over all axes, of a point (metres) and the rotation (radians).

    The point is on the optical axis at ``distance``; ``covariance`` is as in :class:`HandEye`.
    """
    across = np.array([[0, distance, 0], [-distance, 0, 0], [0, 0, 0]])
    jacobian = np.hstack([across, np.eye(3)])
    position = np.trace(jacobian @ covariance @ jacobian.T)
    return float(np.sqrt(position)), float(np.sqrt(np.trace(covariance[:3, :3])))
