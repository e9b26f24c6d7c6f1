"""A simulated robot with a camera and a board, and the data that it reports."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.geometry.camera import camera_matrix, invert_transform, make_transform
from dopepp.geometry.camera_file import Camera
from dopepp.robot.calibration.board import BoardDetection, board_pose, parse_board


@dataclass
class Cell:
    """True poses and camera of a calibration, and the reported poses and detections."""

    camera: Camera
    T_mount_cam: np.ndarray
    T_other_board: np.ndarray
    T_base_flange: np.ndarray
    detections: list[BoardDetection]

    @property
    def boards(self):
        """Poses of the board in the camera's images."""
        return [board_pose(detection, self.camera) for detection in self.detections]


def look_at(eye, target, roll):
    """Return T_world_cam of a camera with a point on its optical axis."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.3, 1.0, 0.1])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    return make_transform(R @ Rotation.from_rotvec([0, 0, roll]).as_matrix(), eye)


def take(board, T_cam_board, camera, name, noise_px=0.0, rng=None):
    """Return the detection of a board in a camera's image."""
    rotation, shift = cv2.Rodrigues(T_cam_board[:3, :3])[0], T_cam_board[:3, 3]
    pixels = cv2.projectPoints(board.points, rotation, shift, camera.K, camera.coefficients)[0]
    noise = noise_px * rng.normal(size=(len(board.points), 2)) if noise_px else 0.0
    return BoardDetection(name, board.points, pixels[:, 0] + noise)


def make_cell(seed=0, num=20, mount="hand", noise=1.0, tilt=0.25):
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
        M = Y @ T_board_cam @ invert_transform(X)
        M = M if mount == "hand" else invert_transform(M)
        turn = Rotation.from_rotvec(noise * np.radians(0.03) * rng.normal(size=3)).as_matrix()
        shift = noise * 3e-4 * rng.normal(size=3)
        robot.append(make_transform(M[:3, :3] @ turn, M[:3, 3] + shift))
        T_cam_board, name = invert_transform(T_board_cam), f"{number:02d}.png"
        detections.append(take(board, T_cam_board, camera, name, 0.15 * noise, rng))
    return Cell(camera, X, Y, np.array(robot), detections)


@pytest.fixture(scope="session")
def cell():
    return make_cell
