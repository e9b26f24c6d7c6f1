"""A simulated robot with a camera and a board, and the data that it reports."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.geometry.camera import camera_matrix, invert_transform, make_transform
from dopepp.geometry.camera_file import Camera
from dopepp.robot.calibration.board import BoardDetection, parse_board


@dataclass
class Cell:
    """True poses and camera of a calibration, and the reported poses and detections."""

    camera: Camera
    T_mount_cam: np.ndarray
    T_other_board: np.ndarray
    T_base_flange: np.ndarray
    detections: list[BoardDetection]


def look_at(eye: np.ndarray, target: np.ndarray, roll: float) -> np.ndarray:
    """Return T_world_cam of a camera with a point on its optical axis."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.3, 1.0, 0.1])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    return make_transform(R @ Rotation.from_rotvec([0, 0, roll]).as_matrix(), eye)


def make_cell(
    seed: int = 0, num: int = 20, mount: str = "hand", noise: float = 1.0, tilt: float = 0.25
) -> Cell:
    """Draw a calibration; a noise of 1 is 0.15 px, 0.3 mm and 0.03°."""
    rng = np.random.default_rng(seed)
    board = parse_board("charuco:9x7:25:18")
    lens = (0.05, -0.1, 0.001, -0.001, 0.0)
    camera = Camera((1280, 960), camera_matrix(1100, 1102, 645, 475), lens, "the cell's")
    X = make_transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.1, 0.1, 3))
    Y = make_transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.5, 0.5, 3))
    middle = board.points.mean(axis=0)
    robot, detections = [], []
    for number in range(num):
        side = np.append(rng.uniform(-tilt, tilt, 2), 0)
        eye = middle + np.array([0, 0, -1]) * rng.uniform(0.35, 0.6) + side
        T_board_cam = look_at(eye, middle + 0.02 * rng.normal(size=3), rng.uniform(-0.8, 0.8))
        T_cam_board = invert_transform(T_board_cam)
        pixels = cv2.projectPoints(
            board.points,
            cv2.Rodrigues(T_cam_board[:3, :3])[0],
            T_cam_board[:3, 3],
            camera.K,
            camera.coefficients,
        )[0][:, 0]
        M = Y @ T_board_cam @ invert_transform(X)
        M = M if mount == "hand" else invert_transform(M)
        rotation = Rotation.from_rotvec(noise * np.radians(0.03) * rng.normal(size=3)).as_matrix()
        robot.append(
            make_transform(M[:3, :3] @ rotation, M[:3, 3] + noise * 3e-4 * rng.normal(size=3))
        )
        pixels = pixels + 0.15 * noise * rng.normal(size=pixels.shape)
        detections.append(BoardDetection(f"{number:02d}.png", board.points, pixels))
    return Cell(camera, X, Y, np.array(robot), detections)


@pytest.fixture(scope="session")
def cell() -> Callable[..., Cell]:
    return make_cell


@pytest.fixture(scope="session")
def looking_at() -> Callable[..., np.ndarray]:
    return look_at
