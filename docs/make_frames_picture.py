"""Draw the coordinate frames of poses, ``docs/images/frames.png``.

python docs/make_frames_picture.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np

from dopepp.core.files import write_png
from dopepp.drawing.overlay import YELLOW, draw_line, draw_text, draw_wireframe
from dopepp.geometry.camera import (
    camera_matrix,
    invert_transform,
    make_transform,
    project,
    project_keypoints,
    transform,
)
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.parts.catalogue import pivconnector

SIZE: Final = (1280, 720)
WATCH: Final = camera_matrix(1750, 1750, 620, 400)
"""Camera matrix of the viewer of the drawing."""

IMAGE: Final = (320, 240)
K: Final = camera_matrix(420, 420, 159.5, 119.5)
AXES: Final = (("x", (240, 60, 60)), ("y", (60, 200, 70)), ("z", (80, 130, 255)))
WHITE: Final = (235, 235, 235)
PART: Final = np.array([200, 150, 90])

T_CAM_OBJ: Final = make_transform(
    rotation_vector_to_matrix(np.array([0.2, -0.1, 0.4]))
    @ rotation_vector_to_matrix(np.array([np.pi, 0.0, 0.0])),
    np.array([0.005, 0.005, 0.25]),
)
"""The part's +z face points to the camera."""

OPTICAL_TO_LINK: Final = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""``camera_link`` has x forward, y left and z up (REP 103); the rows are its axes."""


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return T_watch_cam of a viewer at a position in the camera frame, whose y axis is down."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], 1)
    return invert_transform(make_transform(axes, position))


def draw_part(canvas: np.ndarray, T: np.ndarray, camera: np.ndarray) -> None:
    """Draw the part's triangles IN PLACE, from far to near, lit from the viewer's upper left."""
    mesh = pivconnector().mesh
    assert mesh is not None
    corners = transform(T, mesh.vertices)[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    light = np.abs(normals @ np.array([-0.4, -0.5, -0.77]))
    for face in corners[:, :, 2].mean(1).argsort()[::-1]:
        pixels = np.rint(project(corners[face], camera) * 16).astype(np.int32)
        colour = (PART * (0.35 + 0.65 * light[face])).tolist()
        cv2.fillConvexPoly(canvas, pixels, colour, cv2.LINE_AA, 4)


def draw_frame(
    canvas: np.ndarray, T_watch_frame: np.ndarray, length: float, name: str, away: tuple[int, int]
) -> None:
    """Draw a frame's axes IN PLACE, and its name at an offset in pixels from its origin."""
    tips = np.vstack([np.zeros(3), length * np.eye(3), 1.2 * length * np.eye(3)])
    points = project(transform(T_watch_frame, tips), WATCH)
    for axis, (letter, colour) in enumerate(AXES):
        draw_line(canvas, points[0], points[1 + axis], colour, 4)
        write(canvas, letter, points[4 + axis] - 12, 26, colour)
    for number, line in enumerate(name.split("\n")):
        write(canvas, line, points[0] + [away[0], away[1] + 26 * number], 24, WHITE)


def write(
    canvas: np.ndarray, text: str, pixel: np.ndarray, size_px: int, colour: tuple[int, int, int]
) -> None:
    """Write a line of text IN PLACE at a pixel."""
    column, row = np.rint(pixel).astype(int).tolist()
    draw_text(canvas, text, (max(column, 0), max(row, 0)), size_px, colour)


def camera_image() -> np.ndarray:
    """Return the camera's image of the part, with its cuboid."""
    image = np.full((IMAGE[1], IMAGE[0], 3), 95, np.uint8)
    draw_part(image, T_CAM_OBJ, K)
    keypoints = project_keypoints(pivconnector().cuboid, T_CAM_OBJ, K)
    return draw_wireframe(image, keypoints, YELLOW)


def main() -> None:
    """Draw and write the image."""
    canvas = np.full((SIZE[1], SIZE[0], 3), 45, np.uint8)
    T_watch_cam = look_at(np.array([0.36, -0.25, -0.14]), np.array([0.0, 0.01, 0.12]))
    # The image is drawn on a plane in front of the camera, crossed by the ray of each pixel.
    depth, (width, height) = 0.11, IMAGE
    corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5],
                        [-0.5, height - 0.5]])  # fmt: skip
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(K).T
    plane = project(transform(T_watch_cam, depth * rays), WATCH)
    warp = cv2.getPerspectiveTransform(corners.astype(np.float32), plane.astype(np.float32))
    draw_part(canvas, T_watch_cam @ T_CAM_OBJ, WATCH)
    cuboid = project_keypoints(pivconnector().cuboid, T_watch_cam @ T_CAM_OBJ, WATCH)
    canvas = draw_wireframe(canvas, cuboid, YELLOW)
    shown = cv2.warpPerspective(camera_image(), warp, SIZE)
    mask = cv2.warpPerspective(np.ones((height, width), np.float32), warp, SIZE)[..., None]
    canvas = np.rint(canvas * (1 - 0.85 * mask) + shown * 0.85 * mask).astype(np.uint8)
    origin = project(transform(T_watch_cam, np.zeros((1, 3))), WATCH)[0]
    for corner, neighbour in zip(plane, np.roll(plane, 1, 0), strict=True):
        draw_line(canvas, origin, corner, (150, 150, 150), 1)
        draw_line(canvas, corner, neighbour, (200, 200, 200), 2)
    draw_line(canvas, plane[0], plane[0], WHITE, 9)
    centre = project(transform(T_watch_cam, T_CAM_OBJ[None, :3, 3]), WATCH)[0]
    draw_line(canvas, origin, centre, WHITE, 1)
    write(canvas, "T_cam_obj", 0.25 * origin + 0.75 * centre + [-90, -40], 22, WHITE)
    write(canvas, "pixel (0, 0): u right, v down", plane[0] + [-150, -38], 22, WHITE)
    draw_frame(canvas, T_watch_cam, 0.05, "camera: OpenCV =\nROS optical frame", (-150, -70))
    link = make_transform(OPTICAL_TO_LINK.T, np.array([0.0, -0.085, -0.01]))
    draw_frame(canvas, T_watch_cam @ link, 0.04, "ROS camera_link\n(drawn beside it)", (-40, 60))
    draw_frame(canvas, T_watch_cam @ T_CAM_OBJ, 0.06, "part: the mesh file's frame", (-130, 150))
    write_png(Path(__file__).parent / "images" / "frames.png", canvas)


if __name__ == "__main__":
    main()
