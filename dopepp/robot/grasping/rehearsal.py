"""The calibrations before the grasps (paper 4.3), in the simulation and with its errors.

An arm's joints do not stand quite where its controller reads them, and nobody knows where the
camera's bracket is. Tool, bench, lens and hand-eye are calibrated as a workshop would do it, by
:mod:`dopepp.robot.calibration`, from touched points and pictures of a board.
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
from dopepp.robot.grasping.planner import Arm, Joints, Knowledge

SIZE: Final[Size] = (640, 480)  # of the camera's pictures, pixels
FOCAL: Final = SIZE[0] / 2 / np.tan(np.radians(30.0))
"""Pixels: 60° across, as the released networks were trained."""

TRUE_K: Final[CameraMatrix] = camera_matrix(
    FOCAL, FOCAL, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2
)  # fmt: skip

MOUNT: Final = make_transform(np.eye(3), np.array([0.0, 0.09, 0.11]))
"""T_flange_cam as the bracket was drawn: beside the fingers, which it does not see, looking along
the tool."""

BRACKET: Final = (np.radians(1.0), 0.003)
"""How far it is off the drawing, standard deviations along each axis, radians and metres."""

ZERO: Final = np.radians(0.02)
"""Standard deviation of a joint's zero, radians: 0.3 mm at the flange."""

TOUCH: Final = 1e-4  # standard deviation of a touch, metres along each axis
TOUCHES, VIEWS = 8, 15
BOARD: Final = "charuco:8x6:20:15"
_DOWN: Final = np.diag([1.0, -1.0, -1.0])  # rotation of a tool that looks straight down


@dataclass(frozen=True, eq=False)
class Robot:
    """What is true of a robot and nobody knows."""

    zero: Joints  # how far its joints are from where they are read, radians
    T_flange_cam: Transform  # where the camera is
    tip: Vector  # middle between the ends of the closed fingers, flange frame, metres


@dataclass(frozen=True, eq=False)
class Calibrated:
    """What the calibrations of a robot have found."""

    knowledge: Knowledge
    camera: Camera  # the lens
    hand_eye_mm: float  # how far the camera is off, at the distance of the parts, millimetres
    hand_eye_deg: float  # by how much it is turned, degrees
    tool_mm: float  # how far the tool's tip is off, millimetres
    bench_mm: float  # how far the bench is off below the tray, millimetres


def draw_robot(rng: Generator, tip: Vector) -> Robot:
    """Draw the errors of a robot whose fingers end at a tip when closed."""
    turn, shift = (rng.normal(0, spread, 3) for spread in BRACKET)
    off = make_transform(Rotation.from_rotvec(turn).as_matrix(), shift)
    return Robot(rng.normal(0, ZERO, JOINTS), MOUNT @ off, tip)


def calibrate(robot: Robot, arm: Arm, rng: Generator, distance: float) -> Calibrated:
    """Calibrate tool, bench, lens and hand-eye; ``distance`` is that of the parts, metres."""
    tip = find_tip(_pivoted(robot, arm, rng)).position
    bench = find_bench(_touched(robot, arm, rng, tip)).T_base_bench
    camera, T_flange_cam = _seen(robot, arm, rng)
    known = Knowledge(T_flange_cam, tip, bench)
    ahead = np.array([[0.0, 0.0, distance]])
    away = transform(T_flange_cam, ahead) - transform(robot.T_flange_cam, ahead)
    turn = rotation_angle(T_flange_cam[:3, :3].T @ robot.T_flange_cam[:3, :3])
    height = bench[:3, 2] @ (TRAY - bench[:3, 3])
    return Calibrated(
        known, camera, 1000 * float(np.linalg.norm(away)), float(np.degrees(turn)),
        1000 * float(np.linalg.norm(tip - robot.tip)), 1000 * abs(float(height)),
    )  # fmt: skip


Stand = tuple[Transform, Transform]
"""T_base_flange where the flange is, and where the controller reads it to be."""


def _stand(robot: Robot, arm: Arm, goal: Transform) -> Stand | None:
    """Lead the flange to a pose; None out of reach."""
    joints = arm.joints(goal)
    return None if joints is None else (arm.flange(joints), arm.flange(joints - robot.zero))


def _gathered(draw: Callable[[], Stand | None], count: int) -> list[Stand]:
    """Draw poses until so many are in reach."""
    drawn = (draw() for _ in range(4 * count))
    stands = [stand for stand in drawn if stand is not None][:count]
    if len(stands) < count:
        raise RunError("the arm does not reach the poses of its calibration")
    return stands


def _pivoted(robot: Robot, arm: Arm, rng: Generator) -> Float[np.ndarray, "poses 4 4"]:
    """Return read poses of the flange in which the tip touches one point above the tray."""

    def draw() -> Stand | None:
        turn = Rotation.from_rotvec([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-1, 1)]).as_matrix()
        touched = TRAY + np.array([0.0, 0.0, 0.05]) + rng.normal(0, TOUCH, 3)
        return _stand(robot, arm, make_transform(_DOWN @ turn, touched - _DOWN @ turn @ robot.tip))

    return np.stack([read for _, read in _gathered(draw, TOUCHES)])


def _touched(robot: Robot, arm: Arm, rng: Generator, tip: Vector) -> Float[np.ndarray, "points 3"]:
    """Return points of the bench that the tip has touched, as the controller has them."""

    def draw() -> Stand | None:
        touched = TRAY + np.array([*rng.uniform(-0.1, 0.1, 2), 0.0]) + rng.normal(0, TOUCH, 3)
        return _stand(robot, arm, make_transform(_DOWN, touched - _DOWN @ robot.tip))

    return np.stack([transform(read, tip) for _, read in _gathered(draw, TOUCHES)])


def _seen(robot: Robot, arm: Arm, rng: Generator) -> tuple[Camera, Transform]:
    """Calibrate lens and hand-eye from pictures of a board on the bench."""
    board, true_camera = parse_board(BOARD), Camera(SIZE, TRUE_K, (), "the simulation's")
    middle = board.points.mean(axis=0)
    T_base_board = make_transform(_DOWN, TRAY - _DOWN @ middle)

    def draw() -> Stand | None:
        T_base_cam = looking_at(
            TRAY + np.array([*rng.uniform(-0.03, 0.03, 2), 0.0]), rng.uniform(0.2, 0.32),
            rng.uniform(-0.6, 0.6, 2), rng.uniform(-1.0, 1.0),
        )  # fmt: skip
        return _stand(robot, arm, T_base_cam @ invert_transform(robot.T_flange_cam))

    sightings, flanges = [], []
    for number, (flange, read) in enumerate(_gathered(draw, VIEWS)):
        T_cam_board = invert_transform(flange @ robot.T_flange_cam) @ T_base_board
        picture = draw_view(board, T_cam_board, true_camera, rng)
        sighting = board.find(picture, f"{number}")
        if sighting is not None:
            sightings.append(sighting)
            flanges.append(read)
    camera = calibrate_lens(sightings, SIZE).camera
    boards = [board_pose(one, camera) for one in sightings]
    return camera, calibrate_hand_eye(np.stack(flanges), boards, "hand").T_mount_cam


def looking_at(
    point: Vector, distance: float, tilt: Float[np.ndarray, "2"], roll: float
) -> Transform:
    """Return T_base_cam of a camera that looks down at a point from a distance, metres.

    ``tilt`` turns it about its x and y, ``roll`` about its axis, radians; all 0 look straight down.
    """
    turn = Rotation.from_rotvec([*tilt, 0.0]) * Rotation.from_rotvec([0.0, 0.0, roll])
    rotation = _DOWN @ turn.as_matrix()
    return make_transform(rotation, point - distance * rotation[:, 2])
