"""Where the camera is on the robot: hand-eye and robot-world calibration.

A robot says where its flange is, the camera sees a board. Of a camera in the hand,

    T_base_flange · T_flange_cam · T_cam_board = T_base_board,

of one on the bench, with the board in the hand,

    T_flange_base · T_base_cam · T_cam_board = T_flange_board,

for all poses i: M_i X B_i = Y with two unknowns, X where the camera is and Y where the board is.
Y falls out of pairs of poses (AX = XB: Park and Martin 1994), or is solved for together with X
(AX = ZB: Shah 2013). Both are closed forms of rotation first; the better of them starts a joint
refinement that weighs every pose by what its picture tells and by the robot's own error, and
leaves out poses that contradict the others.
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
from dopepp.geometry.camera import Transform, invert_transform, make_transform
from dopepp.robot.calibration.board import BoardPose, Transforms, displaced

Mount = Literal["hand", "bench"]

Covariances = Float[np.ndarray, "poses 6 6"]
Residuals = Float[np.ndarray, "poses 6"]  # turns (radians) and shifts (metres), camera axes
Noise = Float[np.ndarray, "2"]  # deviations of a robot's turn and shift, radians and metres

MIN_POSES: Final = 3

ROBOT_NOISE: Final = (0.0005, 0.0005)
"""Of a robot's pose to begin with: radians and metres; what the poses show replaces it."""

OUTLIER: Final = 40.0
"""Squared distance of a pose in standard deviations beyond which it contradicts the others: one
in two million of those that do not, with six degrees of freedom."""

MEDIAN_CHI2: Final = 5.348
"""Median of chi-squared with six degrees of freedom."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """Where camera and board are."""

    mount: Mount  # whether the camera is in the `hand` or on the `bench`
    T_mount_cam: Transform  # where the camera is: T_flange_cam in the hand, T_base_cam on the bench
    T_other_board: Transform  # where the board is: T_base_board, or T_flange_board
    # Of a turn of the camera about its own origin and a shift, camera axes (radians, metres).
    covariance: Float[np.ndarray, "6 6"]
    # How far every pose is turned from where the others expect it, radians.
    turns: Float[np.ndarray, "poses"]
    shifts: Float[np.ndarray, "poses"]  # how far it is shifted, metres
    inliers: Bool[np.ndarray, "poses"]  # which poses were used
    # The robot's own deviation that these show, radians and metres.
    robot_noise: tuple[float, float]


def check_mount(mount: str) -> Mount:
    """Return where a camera may be; anything else is a :class:`UserError`."""
    if mount == "hand":
        return "hand"
    if mount == "bench":
        return "bench"
    raise UserError(f"--mount {mount}", "hand or bench", "say where the camera is")


def calibrate_hand_eye(
    T_base_flange: Transforms, boards: Sequence[BoardPose], mount: Mount
) -> HandEye:
    """Find where the camera is from poses of the robot and of the board, pair by pair.

    Raises:
        UserError: There are fewer than three pairs, or the robot turned about one direction only.
    """
    if len(boards) < MIN_POSES:
        raise UserError(
            f"{len(boards)} poses with the board in sight", f"at least {MIN_POSES}, better 15",
            "add poses, turned by 30° and more about different axes",
        )  # fmt: skip
    M, B, seen = equations(T_base_flange, boards, mount)
    starts = [solve(M, B) for solve in (park, shah)]
    costs = [np.median(np.linalg.norm(_residuals(M, B, *one), axis=1)) for one in starts]
    X, Y = starts[int(np.argmin(costs))]
    inliers = np.ones(len(M), bool)
    robot = np.array(ROBOT_NOISE)
    for _ in range(4):
        X, Y, covariance = refined(M[inliers], B[inliers], seen[inliers], X, Y, robot)
        robot = _robot_noise(_residuals(M, B, X, Y)[inliers], seen[inliers], robot)
        distances = _distances(M, B, seen, X, Y, robot)
        scale = max(1.0, float(np.median(distances[inliers])) / MEDIAN_CHI2)
        inliers = distances <= OUTLIER * scale
        if inliers.sum() < MIN_POSES:
            inliers = distances <= np.sort(distances)[MIN_POSES - 1]
    residuals = _residuals(M, B, X, Y)
    turns, shifts = (np.linalg.norm(residuals[:, k : k + 3], axis=1) for k in (0, 3))
    noise = (float(robot[0]), float(robot[1]))
    return HandEye(mount, X, Y, covariance, turns, shifts, inliers, noise)


def equations(
    T_base_flange: Transforms, boards: Sequence[BoardPose], mount: Mount
) -> tuple[Transforms, Transforms, Covariances]:
    """Return M and B of M_i X B_i = Y, and the covariances of B."""
    M = np.asarray(T_base_flange, np.float64)
    B = np.stack([one.T_cam_board for one in boards])
    covariances = np.stack([one.covariance for one in boards])
    return (M if mount == "hand" else inverted(M)), B, covariances


def park(M: Transforms, B: Transforms) -> tuple[Transform, Transform]:
    """Solve M_i X B_i = Y by pairs: (M_j⁻¹ M_i) X = X (B_j B_i⁻¹) (Park and Martin 1994).

    The turns' vectors α = R_X β are aligned over all pairs, then shifts follow linearly.
    """
    P, Q = pairs(M, B)
    alpha, beta = (Rotation.from_matrix(one[:, :3, :3]).as_rotvec() for one in (P, Q))
    R = nearest_rotation(alpha.T @ beta)
    system = (P[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    target = (Q[:, :3, 3] @ R.T - P[:, :3, 3]).ravel()
    X = make_transform(R, np.linalg.lstsq(system, target, rcond=None)[0])
    boards = M @ X @ B
    R_board = nearest_rotation(boards[:, :3, :3].sum(axis=0))
    return X, make_transform(R_board, boards[:, :3, 3].mean(axis=0))


def shah(M: Transforms, B: Transforms) -> tuple[Transform, Transform]:
    """Solve M_i X = Y B_i⁻¹ for X and Y at once (Shah 2013).

    vec(R_Y) = (R_C ⊗ R_M) vec(R_X) with C = B⁻¹, so both rotations are the leading singular
    vectors of the sum over all poses; shifts follow linearly.
    """
    C = inverted(B)
    kronecker = np.einsum("nij,nkl->ikjl", C[:, :3, :3], M[:, :3, :3]).reshape(9, 9)
    left, _, right = np.linalg.svd(kronecker)
    vectors = (one.reshape(3, 3).T for one in (left[:, 0], right[0]))  # known up to their signs
    R_Y, R_X = (nearest_rotation(np.sign(np.linalg.det(one)) * one) for one in vectors)
    system = np.concatenate([np.hstack([one[:3, :3], -np.eye(3)]) for one in M])
    target = (C[:, :3, 3] @ R_Y.T - M[:, :3, 3]).ravel()
    shifts = np.linalg.lstsq(system, target, rcond=None)[0]
    return make_transform(R_X, shifts[:3]), make_transform(R_Y, shifts[3:])


def pairs(M: Transforms, B: Transforms) -> tuple[Transforms, Transforms]:
    """Return the motions M_j⁻¹ M_i of the robot and B_j B_i⁻¹ of the board, i < j."""
    i, j = np.triu_indices(len(M), 1)
    return inverted(M)[j] @ M[i], B[j] @ inverted(B)[i]


def refined(
    M: Transforms, B: Transforms, seen: Covariances, X: Transform, Y: Transform, robot: Noise
) -> tuple[Transform, Transform, Float[np.ndarray, "6 6"]]:
    """Return X and Y of robust least squares, and the covariance of X (:class:`HandEye`).

    X and Y are starts, ``seen`` the covariances of B, ``robot`` the deviations of the robot's turn
    (radians) and shift (metres).
    """
    whitening = np.linalg.inv(np.linalg.cholesky(_covariances(M, X, Y, seen, robot)))

    def residuals(step: Float[np.ndarray, "12"]) -> Float[np.ndarray, "numbers"]:
        moved = displaced(np.stack([X, Y]), step.reshape(2, 6))
        return np.asarray((whitening @ _residuals(M, B, *moved)[..., None]).ravel())

    scale = np.tile(np.repeat([1e-3, 1e-3], 3), 2)
    found = least_squares(residuals, np.zeros(12), x_scale=scale, loss="soft_l1", f_scale=3.0)
    moved = displaced(np.stack([X, Y]), found.x.reshape(2, 6))
    jacobian = np.asarray(found.jac)
    covariance = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14)[:6, :6]
    turn = np.kron(np.eye(2), moved[0][:3, :3])  # to the camera's own axes
    return moved[0], moved[1], turn.T @ covariance @ turn


def _residuals(M: Transforms, B: Transforms, X: Transform, Y: Transform) -> Residuals:
    """Return how the seen board is turned (about its origin) and shifted, camera axes."""
    expected = invert_transform(X) @ inverted(M) @ Y
    turn = Rotation.from_matrix(B[:, :3, :3] @ expected[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([turn, B[:, :3, 3] - expected[:, :3, 3]], axis=1)


def _covariances(
    M: Transforms, X: Transform, Y: Transform, seen: Covariances, robot: Noise
) -> Covariances:
    """Return the covariances of the residuals: what pictures tell and what the robot adds."""
    return np.asarray(seen + _robot_part(M, X, Y) @ np.diag(np.repeat(robot**2, 3)) @
                      _robot_part(M, X, Y).transpose(0, 2, 1))  # fmt: skip


def _robot_part(M: Transforms, X: Transform, Y: Transform) -> Covariances:
    """Return how a small turn and shift of the robot's pose moves the board, camera axes.

    The turn is about the origin of the frame that the camera is mounted on.
    """
    to_cam = X[:3, :3].T
    board = (inverted(M) @ Y)[:, :3, 3]  # in the frame of the mount
    part = np.zeros((len(M), 6, 6))
    part[:, :3, :3] = part[:, 3:, 3:] = to_cam
    part[:, 3:, :3] = -to_cam @ _cross(board)
    return part


def _robot_noise(residuals: Residuals, seen: Covariances, robot: Noise) -> Noise:
    """Return the robot's deviations (radians, metres) that residuals show beyond the pictures'.

    Robust: by medians. A robot is taken to be no better than a fifth of :data:`ROBOT_NOISE`.
    """
    variances = np.diagonal(seen, axis1=1, axis2=2)
    beyond = np.array(
        [
            np.median(residuals[:, k : k + 3] ** 2 - 0.455 * variances[:, k : k + 3]) / 0.455
            for k in (0, 3)
        ]
    )
    return np.asarray(np.sqrt(np.maximum(beyond, (0.2 * np.array(ROBOT_NOISE)) ** 2)))


def _distances(
    M: Transforms, B: Transforms, seen: Covariances, X: Transform, Y: Transform, robot: Noise
) -> Float[np.ndarray, "poses"]:
    """Return every pose's squared distance from what is expected, standard deviations."""
    residuals = _residuals(M, B, X, Y)
    whole = np.linalg.solve(_covariances(M, X, Y, seen, robot), residuals[..., None])[..., 0]
    return np.asarray((residuals * whole).sum(axis=1))


def inverted(T: Transforms) -> Transforms:
    """Return the inverse of every rigid transform."""
    turned = T[:, :3, :3].transpose(0, 2, 1)
    back = np.tile(np.eye(4), (len(T), 1, 1))
    back[:, :3, :3] = turned
    back[:, :3, 3] = -(turned @ T[:, :3, 3:])[..., 0]
    return back


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation nearest to a matrix (Frobenius norm)."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def _cross(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Return the matrices that take the cross product with every vector."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
