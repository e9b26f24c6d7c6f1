"""Simulated calibrations before the grasps (paper 4.3), with realistic errors.

The arm's joints differ from the controller's readings, and the camera's bracket differs from its
nominal shape. Tool, bench, lens and hand-eye are calibrated by :mod:`dopepp.robot.calibration`,
from touched points and images of a board.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from dopepp.core.errors import RunError
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    camera_matrix,
    invert_transform,
    make_transform,
    transform,
)
from dopepp.geometry.camera_file import Camera
from dopepp.geometry.rotation import Vector, rotation_angle
from dopepp.robot.calibration.board import board_pose, draw_view, parse_board
from dopepp.robot.calibration.hand_eye import calibrate_hand_eye
from dopepp.robot.calibration.lens import calibrate_lens
from dopepp.robot.calibration.tool import find_bench, find_tip
from dopepp.robot.grasping.cell import JOINTS, TRAY
from dopepp.robot.grasping.planner import Arm, ControllerParameters, Joints

SIZE: Final[Size] = (640, 480)  # (width, height) of the camera's images, pixels
FOCAL: Final = SIZE[0] / 2 / np.tan(np.radians(30.0))  # 60° across, as in the networks' training
TRUE_K: Final[CameraMatrix] = camera_matrix(FOCAL, FOCAL, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)

# Nominal T_flange_cam: beside the fingers, which are not in view, with z along the tool.
MOUNT: Final = make_transform(np.eye(3), np.array([0.0, 0.09, 0.11]))
BRACKET: Final = (np.radians(1.0), 0.003)  # standard deviations about and along each axis
ZERO: Final = np.radians(0.02)  # standard deviation of a joint's zero: 0.3 mm at the flange
TOUCH: Final = 1e-4  # standard deviation of a touched point along each axis, metres
TOUCHES, VIEWS = 8, 15  # number of touched points per calibration, and of images of the board
BOARD: Final = "charuco:8x6:20:15"
_DOWN: Final = np.diag([1.0, -1.0, -1.0])  # rotation of a tool that points straight down


@dataclass(frozen=True, eq=False)
class TrueRobot:
    """True geometry of a simulated robot, unknown to its controller."""

    zero: Joints  # true joints minus the controller's readings, radians
    T_flange_cam: Transform
    tip: Vector  # midpoint between the ends of the closed fingers, flange frame, metres


@dataclass(frozen=True, eq=False)
class CalibratedRobot:
    """Results of a robot's simulated calibrations, and the errors of the hand-eye transform."""

    knowledge: ControllerParameters
    camera: Camera
    hand_eye_mm: float  # shift of a point at the parts' distance
    hand_eye_deg: float


def draw_robot(rng: Generator, tip: Vector) -> TrueRobot:
    """Sample the errors of a robot's joints and camera; ``tip`` is as in :class:`TrueRobot`."""
    angle, shift = (rng.normal(0, spread, 3) for spread in BRACKET)
    error = make_transform(Rotation.from_rotvec(angle).as_matrix(), shift)
    return TrueRobot(rng.normal(0, ZERO, JOINTS), MOUNT @ error, tip)


def calibrate(robot: TrueRobot, arm: Arm, rng: Generator, distance: float) -> CalibratedRobot:
    """Calibrate tool, bench, lens and hand-eye; report the error at a camera distance, metres."""
    tip = find_tip(_pivot_poses(robot, arm, rng)).position
    bench = find_bench(_touch_bench(robot, arm, rng, tip)).T_base_bench
    camera, T_flange_cam = _calibrate_camera(robot, arm, rng)
    ahead = np.array([[0.0, 0.0, distance]])
    shift = transform(T_flange_cam, ahead) - transform(robot.T_flange_cam, ahead)
    angle = rotation_angle(T_flange_cam[:3, :3].T @ robot.T_flange_cam[:3, :3])
    errors = (1000 * float(np.linalg.norm(shift)), float(np.degrees(angle)))
    return CalibratedRobot(ControllerParameters(T_flange_cam, tip, bench), camera, *errors)


FlangePair = tuple[Transform, Transform]  # T_base_flange: true pose, and controller's reading


def _move(robot: TrueRobot, arm: Arm, goal: Transform) -> FlangePair | None:
    """Return the flange's true and measured pose after a motion to a goal; None out of reach."""
    joints = arm.joints(goal)
    return None if joints is None else (arm.flange(joints), arm.flange(joints - robot.zero))


def _draw_reachable(draw: Callable[[], FlangePair | None], count: int) -> list[FlangePair]:
    """Return ``count`` reachable poses; raise a ``RunError`` after 4 × ``count`` samples."""
    drawn = (draw() for _ in range(4 * count))
    pairs = [pair for pair in drawn if pair is not None][:count]
    if len(pairs) < count:
        raise RunError("the simulated arm reaches too few poses to calibrate its camera")
    return pairs


def _pivot_poses(robot: TrueRobot, arm: Arm, rng: Generator) -> Float[np.ndarray, "poses 4 4"]:
    """Return the measured T_base_flange of poses in which the tip touches a point over the tray."""

    def draw() -> FlangePair | None:
        angle = Rotation.from_rotvec([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-1, 1)]).as_matrix()
        touched = TRAY + np.array([0.0, 0.0, 0.05]) + rng.normal(0, TOUCH, 3)
        return _move(robot, arm, make_transform(_DOWN @ angle, touched - _DOWN @ angle @ robot.tip))

    return np.stack([read for _, read in _draw_reachable(draw, TOUCHES)])


def _touch_bench(
    robot: TrueRobot, arm: Arm, rng: Generator, tip: Vector
) -> Float[np.ndarray, "points 3"]:
    """Return measured points of the bench, base frame, metres; ``tip`` is the calibrated tip."""

    def draw() -> FlangePair | None:
        touched = TRAY + np.array([*rng.uniform(-0.1, 0.1, 2), 0.0]) + rng.normal(0, TOUCH, 3)
        return _move(robot, arm, make_transform(_DOWN, touched - _DOWN @ robot.tip))

    return np.stack([transform(read, tip) for _, read in _draw_reachable(draw, TOUCHES)])


def _calibrate_camera(robot: TrueRobot, arm: Arm, rng: Generator) -> tuple[Camera, Transform]:
    """Return camera and T_flange_cam, calibrated from rendered images of a board on the bench."""
    board, true_camera = parse_board(BOARD), Camera(SIZE, TRUE_K, (), "simulation")
    middle = board.points.mean(axis=0)
    T_base_board = make_transform(_DOWN, TRAY - _DOWN @ middle)

    def draw() -> FlangePair | None:
        point = TRAY + np.array([*rng.uniform(-0.03, 0.03, 2), 0.0])
        distance, tilt = rng.uniform(0.2, 0.32), rng.uniform(-0.6, 0.6, 2)
        T_base_cam = downward_view(point, distance, tilt, rng.uniform(-1.0, 1.0))
        return _move(robot, arm, T_base_cam @ invert_transform(robot.T_flange_cam))

    detections, flanges = [], []
    for number, (flange, read) in enumerate(_draw_reachable(draw, VIEWS)):
        T_cam_board = invert_transform(flange @ robot.T_flange_cam) @ T_base_board
        image = draw_view(board, T_cam_board, true_camera, rng)
        detection = board.detect(image, f"{number}")
        if detection is not None:
            detections.append(detection)
            flanges.append(read)
    camera = calibrate_lens(detections, SIZE).camera
    boards = [board_pose(detection, camera) for detection in detections]
    return camera, calibrate_hand_eye(np.stack(flanges), boards, "hand").T_mount_cam


def downward_view(
    point: Vector, distance: float, tilt: Float[np.ndarray, "2"], roll: float
) -> Transform:
    """Return T_base_cam of a camera above a point, with the point on its optical axis.

    ``tilt`` rotates about the camera's x and y axes from straight down, ``roll`` about its optical
    axis, radians.
    """
    angle = Rotation.from_rotvec([*tilt, 0.0]) * Rotation.from_rotvec([0.0, 0.0, roll])
    rotation = _DOWN @ angle.as_matrix()
    return make_transform(rotation, point - distance * rotation[:, 2])
