"""Pictures of a board as a camera would take them: to rehearse a calibration and to test it."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import Transform
from dopepp.geometry.camera_file import Camera
from dopepp.robot.calibration.board import PX_PER_MM, Board

OVERSAMPLED: Final = 2

BACKGROUND: Final = 110


def draw_view(
    board: Board,
    T_cam_board: Transform,
    camera: Camera,
    rng: np.random.Generator,
    noise: float = 4.0,
) -> Picture:
    """Draw a board at a pose, with the camera's lens and noise (grey levels).

    Every pixel looks along its ray at the board's plane; two by two rays a pixel.
    """  # fmt: skip
    assert camera.size is not None
    width, height = camera.size
    steps = (np.arange(OVERSAMPLED) + 0.5) / OVERSAMPLED - 0.5
    u = (np.arange(width)[:, None] + steps).ravel()
    v = (np.arange(height)[:, None] + steps).ravel()
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, camera.K, camera.coefficients)[:, 0]
    R, t = T_cam_board[:3, :3], T_cam_board[:3, 3]
    # A point of the board, (x, y, 0), is seen along R[:, :2] (x, y) + t.
    homography = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], t]))
    on_board = np.column_stack([rays, np.ones(len(rays))]) @ homography.T
    at = 1000 * PX_PER_MM * on_board[:, :2] / on_board[:, 2:]
    at = (at + board.first_px - 0.5).astype(np.float32).reshape(len(v), len(u), 2)
    page = cv2.GaussianBlur(board.drawing(), (0, 0), 0.4 * PX_PER_MM * _mm_per_pixel(camera, t))
    drawn = cv2.remap(
        page, at[..., 0], at[..., 1], cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=BACKGROUND,
    )  # fmt: skip
    grey = drawn.reshape(height, OVERSAMPLED, width, OVERSAMPLED).mean(axis=(1, 3))
    grey = 20 + 0.8 * grey + rng.normal(0, noise, grey.shape)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def _mm_per_pixel(camera: Camera, t: np.ndarray) -> float:
    return float(1000 * t[2] / camera.K[0, 0])
