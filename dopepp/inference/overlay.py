"""Poses on a picture, as a person judges them: silhouette, cuboid, axes, name and score.

A silhouette is that of the part's own mesh at the pose, so where the pose is right it ends where
the part ends, which a cuboid does not show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Int

from dopepp.drawing.overlay import (
    MIN_WIDTH_PX,
    YELLOW,
    Colour,
    draw_line,
    draw_tags,
    draw_wireframe,
    enlarge,
)
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    crop_camera,
    project,
    resize_camera,
    resize_points,
    transform,
)
from dopepp.inference.refinement.outline import OutlineMesh, filled_mask, make_outline_mesh, posed
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection

COLOURS: Final[tuple[Colour, ...]] = (
    YELLOW, (255, 120, 200), (90, 230, 240), (255, 150, 50), (170, 140, 255), (170, 230, 80),
)  # fmt: skip
"""Of the instances on a picture, in turn: neighbours are told apart."""

AXES: Final[tuple[Colour, ...]] = ((240, 50, 50), (50, 200, 50), (70, 110, 255))
"""Of the object's x, y and z axis."""

AXIS: Final = 0.35  # length of a drawn axis, diameters
LINE: Final = 1 / 640  # width of a line, share of the picture's width

FINEST: Final = 1 / 60
"""Widest line, share of the instance's extent: a small part on a large picture stays visible."""


@dataclass(frozen=True, eq=False)
class Shape:
    """How a part is drawn."""

    diameter: float  # metres
    # Its triangles; None where nobody has them, and only its cuboid can be drawn
    mesh: OutlineMesh | None


def make_shape(part: Part) -> Shape:
    """Prepare what is drawn of a part."""
    mesh = part.mesh
    return Shape(
        part.diameter, None if mesh is None else make_outline_mesh(mesh.vertices, mesh.faces)
    )


def draw_poses(
    image: Picture,
    K: CameraMatrix,
    detections: Sequence[Detection],
    labels: Sequence[str],
    shapes: Mapping[str, Shape],
) -> Picture:
    """Return a copy of the picture with poses on it, enlarged where it is narrow."""
    factor = max(1, -(-MIN_WIDTH_PX // image.shape[1]))
    canvas, K = enlarge(image, factor), resize_camera(K, factor, factor)
    places = []
    for number, one in enumerate(detections):
        colour = COLOURS[number % len(COLOURS)]
        keypoints = resize_points(one.keypoints, factor, factor)
        width = _line_width(canvas, keypoints)
        canvas = draw_wireframe(canvas, keypoints, colour, max(1, width // 2))
        if (shape := shapes.get(one.object)) is not None:
            for contour in silhouette(shape, one.T_cam_obj, K, canvas):
                cv2.polylines(canvas, [contour], True, colour, width + 1, cv2.LINE_AA)
            _draw_axes(canvas, one.T_cam_obj, K, shape.diameter, width + 1)
        places.append(_top_left(keypoints))
    colours = [COLOURS[number % len(COLOURS)] for number in range(len(detections))]
    draw_tags(canvas, list(zip(labels, places, colours, strict=True)))
    return canvas


def silhouette(
    shape: Shape, T_cam_obj: Transform, K: CameraMatrix, picture: Picture
) -> list[Int[np.ndarray, "points 1 2"]]:
    """Return the closed lines around what a posed mesh covers of a picture, pixels.

    There are none without a mesh, or where some of it is not before the camera.
    """
    at = None if shape.mesh is None else posed(shape.mesh, T_cam_obj, K)
    if at is None or shape.mesh is None:
        return []
    # A pixel beyond the picture, so that what leaves it gets no line along the border.
    low = np.maximum(np.floor(at.pixels.min(axis=0)) - 1, -2).astype(int)
    high = np.minimum(
        np.ceil(at.pixels.max(axis=0)) + 2, [picture.shape[1] + 2, picture.shape[0] + 2]
    )
    width, height = (high - low).astype(int)
    if min(width, height) <= 0:
        return []
    at = posed(shape.mesh, T_cam_obj, crop_camera(K, *low))
    assert at is not None
    mask = filled_mask(shape.mesh, at, (int(width), int(height)))
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return [np.asarray(contour + low.reshape(1, 1, 2)) for contour in contours]


def _draw_axes(
    canvas: Picture, T_cam_obj: Transform, K: CameraMatrix, diameter: float, width: int
) -> None:
    """Draw the object's axes IN PLACE, the farthest one first."""
    ends = transform(T_cam_obj, np.vstack([np.zeros(3), AXIS * diameter * np.eye(3)]))
    pixels = project(ends, K)
    for axis in np.argsort(-ends[1:, 2]).tolist():
        draw_line(canvas, pixels[0], pixels[1 + axis], AXES[axis], width)


def _line_width(canvas: Picture, keypoints: Float[np.ndarray, "9 2"]) -> int:
    seen = keypoints[np.isfinite(keypoints).all(axis=1)]
    extent = float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0
    widest = LINE * float(canvas.shape[1])
    return max(1, round(min(widest, math.ceil(FINEST * extent))))


def _top_left(keypoints: Float[np.ndarray, "9 2"]) -> tuple[float, float]:
    seen = keypoints[np.isfinite(keypoints).all(axis=1)]
    if not len(seen):
        return 0.0, 0.0
    return float(seen[:, 0].min()), float(seen[:, 1].min())
