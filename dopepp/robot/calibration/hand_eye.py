"""Hand-eye and robot-world calibration: the camera's pose on the robot.

The robot reports its flange's pose, the camera observes a board. For a camera on the flange,

    T_base_flange · T_flange_cam · T_cam_board = T_base_board,

for a camera on the bench, with the board on the flange,

    T_flange_base · T_base_cam · T_cam_board = T_flange_board,

for all poses i: M_i X B_i = Y with the unknown poses X of the camera and Y of the board.
Park and Martin (1994) eliminate Y by pairs of poses (AX = XB); Shah (2013) solves for X and Y
together (AX = ZB). Both methods have closed forms, rotation first. The better solution initialises
a joint refinement, which weights every pose by the covariances of image and robot, and rejects
outliers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import Transform, invert_transform, make_transform, move_pose
from dopepp.geometry.refine import covariance_of
from dopepp.geometry.rotation import nearest_rotation
from dopepp.robot.calibration.board import BoardPose, Transforms

Mount = Literal["hand", "bench"]
MOUNTS: Final[tuple[Mount, Mount]] = ("hand", "bench")

Covariances = Float[np.ndarray, "poses 6 6"]
Residuals = Float[np.ndarray, "poses 6"]  # rotations (radians), translations (metres), camera axes
Noise = Float[np.ndarray, "2"]  # standard deviations of a robot's pose: radians, metres
MIN_POSES: Final = 3
ROBOT_NOISE: Final = (0.0005, 0.0005)  # initial standard deviations, radians and metres
OUTLIER: Final = 40.0  # squared Mahalanobis distance; one in two million correct poses exceeds it
MEDIAN_CHI2: Final = 5.348  # median of chi-squared with six degrees of freedom


@dataclass(frozen=True, eq=False)
class HandEye:
    """Hand-eye calibration: the poses of the camera and the board, and their errors."""

    mount: Mount  # `hand` (the camera is on the flange) or `bench`
    T_mount_cam: Transform  # T_flange_cam, or T_base_cam of a camera on the bench
    T_other_board: Transform  # T_base_board, or T_flange_board of a camera on the bench
    # Of the camera's rotation about its origin (radians) and translation (metres), camera axes
    covariance: Float[np.ndarray, "6 6"]
    # Rotation (radians) and distance (metres) between each observed and predicted T_cam_board
    rotation_errors: Float[np.ndarray, "poses"]
    shifts: Float[np.ndarray, "poses"]
    inliers: Bool[np.ndarray, "poses"]  # poses that were not rejected
    robot_noise: tuple[float, float]  # standard deviations of the flange's pose, radians and metres


def calibrate_hand_eye(
    T_base_flange: Transforms, boards: Sequence[BoardPose], mount: Mount
) -> HandEye:
    """Estimate the camera's pose on its mount from poses of the flange and of the board.

    Raises:
        UserError: There are fewer than three poses.
    """
    if len(boards) < MIN_POSES:
        raise UserError(
            f"{len(boards)} poses with a visible board",
            f"at least {MIN_POSES}, better 15",
            "record more poses, rotated by 30° or more about different axes",
        )
    M, B, B_cov = robot_world_equations(T_base_flange, boards, mount)
    starts = [solve(M, B) for solve in (park, shah)]
    costs = [np.median(np.linalg.norm(_residuals(M, B, *start), axis=1)) for start in starts]
    X, Y = starts[int(np.argmin(costs))]
    inliers = np.ones(len(M), bool)
    robot = np.array(ROBOT_NOISE)
    for _ in range(4):
        X, Y, covariance = refine(M[inliers], B[inliers], B_cov[inliers], X, Y, robot, mount)
        residuals = _residuals(M, B, X, Y)
        robot = _robot_noise(residuals[inliers], B_cov[inliers])
        distances = _distances(residuals, _covariances(M, X, Y, B_cov, robot, mount))
        scale = max(1.0, float(np.median(distances[inliers])) / MEDIAN_CHI2)
        inliers = distances <= OUTLIER * scale
        if inliers.sum() < MIN_POSES:
            inliers = distances <= np.sort(distances)[MIN_POSES - 1]
    residuals = _residuals(M, B, X, Y)
    rotation_errors, shifts = (np.linalg.norm(residuals[:, k : k + 3], axis=1) for k in (0, 3))
    robot_noise = (float(robot[0]), float(robot[1]))
    return HandEye(mount, X, Y, covariance, rotation_errors, shifts, inliers, robot_noise)


def robot_world_equations(
    T_base_flange: Transforms, boards: Sequence[BoardPose], mount: Mount
) -> tuple[Transforms, Transforms, Covariances]:
    """Return M, B = T_cam_board and B's covariances of M X B = Y (see :mod:`.hand_eye`).

    M is T_base_flange for a camera on the hand, and T_flange_base for a camera on the bench.
    """
    M = np.asarray(T_base_flange, np.float64)
    B = np.stack([board.T_cam_board for board in boards])
    covariances = np.stack([board.covariance for board in boards])
    return (M if mount == "hand" else np.linalg.inv(M)), B, covariances


def park(M: Transforms, B: Transforms) -> tuple[Transform, Transform]:
    """Solve M_i X B_i = Y for the poses X of the camera and Y of the board (Park and Martin 1994).

    R_X aligns the rotation vectors in (M_j⁻¹ M_i) X = X (B_j B_i⁻¹). Translations are linear then.
    """
    P, Q = relative_motions(M, B)
    alpha, beta = (Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in (P, Q))
    R = nearest_rotation(alpha.T @ beta)
    system = (P[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    target = (Q[:, :3, 3] @ R.T - P[:, :3, 3]).ravel()
    X = make_transform(R, np.linalg.lstsq(system, target, rcond=None)[0])
    boards = M @ X @ B
    R_board = nearest_rotation(boards[:, :3, :3].sum(axis=0))
    return X, make_transform(R_board, boards[:, :3, 3].mean(axis=0))


def shah(M: Transforms, B: Transforms) -> tuple[Transform, Transform]:
    """Solve M_i X = Y B_i⁻¹ for the poses X of the camera and Y of the board (Shah 2013).

    vec(R_Y) = (R_C ⊗ R_M) vec(R_X) with C = B⁻¹, so both rotations are the leading singular
    vectors of the sum over all poses. The translations solve a linear system.
    """
    C = np.linalg.inv(B)
    kronecker = np.einsum("nij,nkl->ikjl", C[:, :3, :3], M[:, :3, :3]).reshape(9, 9)
    left, _, right = np.linalg.svd(kronecker)
    matrices = (vector.reshape(3, 3).T for vector in (left[:, 0], right[0]))  # up to their signs
    R_Y, R_X = (nearest_rotation(np.sign(np.linalg.det(R)) * R) for R in matrices)
    system = np.concatenate([np.hstack([T[:3, :3], -np.eye(3)]) for T in M])
    target = (C[:, :3, 3] @ R_Y.T - M[:, :3, 3]).ravel()
    shifts = np.linalg.lstsq(system, target, rcond=None)[0]
    return make_transform(R_X, shifts[:3]), make_transform(R_Y, shifts[3:])


def relative_motions(M: Transforms, B: Transforms) -> tuple[Transforms, Transforms]:
    """Return the motions M_j⁻¹ M_i of the robot and B_j B_i⁻¹ of the board for all pairs i < j."""
    i, j = np.triu_indices(len(M), 1)
    return np.linalg.inv(M)[j] @ M[i], B[j] @ np.linalg.inv(B)[i]


def refine(
    M: Transforms,
    B: Transforms,
    B_cov: Covariances,
    X: Transform,
    Y: Transform,
    robot: Noise,
    mount: Mount,
) -> tuple[Transform, Transform, Float[np.ndarray, "6 6"]]:
    """Refine X and Y of M_i X B_i = Y by least squares with a soft L1 loss.

    ``B_cov`` are the covariances of B. Returns X, Y, and the covariance of X (:class:`HandEye`).
    """
    whitening = np.linalg.inv(np.linalg.cholesky(_covariances(M, X, Y, B_cov, robot, mount)))

    def residuals(step: Float[np.ndarray, "12"]) -> Float[np.ndarray, "numbers"]:
        moved = move_pose(np.stack([X, Y]), step.reshape(2, 6))
        return np.asarray((whitening @ _residuals(M, B, *moved)[..., None]).ravel())

    scale = np.tile(np.repeat([1e-3, 1e-3], 3), 2)
    solution = least_squares(residuals, np.zeros(12), x_scale=scale, loss="soft_l1", f_scale=3.0)
    X, Y = move_pose(np.stack([X, Y]), solution.x.reshape(2, 6))
    jacobian = np.asarray(solution.jac)
    covariance = covariance_of(jacobian.T @ jacobian)[:6, :6]
    to_cam = np.kron(np.eye(2), X[:3, :3])
    return X, Y, to_cam.T @ covariance @ to_cam


def _residuals(M: Transforms, B: Transforms, X: Transform, Y: Transform) -> Residuals:
    """Return rotation (rad) and translation (m) from X⁻¹ M⁻¹ Y, the expected board pose, to B."""
    expected = invert_transform(X) @ np.linalg.inv(M) @ Y
    rotvec = Rotation.from_matrix(B[:, :3, :3] @ expected[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([rotvec, B[:, :3, 3] - expected[:, :3, 3]], axis=1)


def _covariances(
    M: Transforms, X: Transform, Y: Transform, B_cov: Covariances, robot: Noise, mount: Mount
) -> Covariances:
    """Return the covariances of :func:`_residuals`: ``B_cov`` plus the propagated robot noise."""
    # Derivative of the board's pose by the robot's, which rotates about the flange's origin.
    to_cam, T_mount_other = X[:3, :3].T, np.linalg.inv(M)
    jacobian = np.zeros((len(M), 6, 6))
    jacobian[:, :3, :3] = jacobian[:, 3:, 3:] = to_cam
    shifts = (T_mount_other @ Y)[:, :3, 3]  # from the flange's origin to the board's
    if mount == "bench":
        shifts = shifts - T_mount_other[:, :3, 3]
    jacobian[:, 3:, :3] = -to_cam @ np.cross(np.eye(3), shifts[:, None])  # of v ↦ shift × v
    variances = np.diag(np.repeat(robot**2, 3))
    return np.asarray(B_cov + jacobian @ variances @ jacobian.transpose(0, 2, 1))


def _robot_noise(residuals: Residuals, B_cov: Covariances) -> Noise:
    """Estimate the robot's noise from the median squared residuals minus the board's variances.

    The smallest estimate is a fifth of :data:`ROBOT_NOISE`.
    """
    excess = residuals**2 - 0.455 * np.diagonal(B_cov, axis1=1, axis2=2)
    variances = np.array([np.median(excess[:, k : k + 3]) / 0.455 for k in (0, 3)])
    return np.asarray(np.sqrt(np.maximum(variances, (0.2 * np.array(ROBOT_NOISE)) ** 2)))


def _distances(residuals: Residuals, covariances: Covariances) -> Float[np.ndarray, "poses"]:
    """Return each board pose's squared Mahalanobis distance from X⁻¹ M⁻¹ Y, the expected pose."""
    weighted = np.linalg.solve(covariances, residuals[..., None])[..., 0]
    return np.asarray((residuals * weighted).sum(axis=1))
