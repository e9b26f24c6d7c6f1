"""PoseResult: the detections in one frame, which can be drawn, saved and exported.

All poses are in the camera frame (:data:`FRAME`), which every output states. Silhouettes are drawn
from the part's mesh: at a correct pose, they coincide with the part's outline on the image.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
from jaxtyping import Int

from dopepp.core.files import IMAGES, check_target, write_image
from dopepp.drawing.overlay import (
    MIN_WIDTH_PX,
    YELLOW,
    Colour,
    draw_caption,
    draw_line,
    draw_tags,
    draw_wireframe,
    enlarge,
)
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    crop_camera,
    project,
    resize_camera,
    resize_points,
    transform,
)
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.inference.refinement.outline import OutlineMesh, filled_mask, make_outline_mesh, posed
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection

if TYPE_CHECKING:
    import pandas as pd

# Undistorting and resizing, network, poses from maps or templates, refinement.
STEPS: Final = ("pre", "network", "decode", "refine")
FRAME: Final = "camera, OpenCV: x right, y down, z forward; metres"  # frame of T_cam_obj

# Colours of the instances on an image, in turn.
COLOURS: Final[tuple[Colour, ...]] = (
    YELLOW,
    (255, 120, 200),
    (90, 230, 240),
    (255, 150, 50),
    (170, 140, 255),
    (170, 230, 80),
)
AXES: Final[tuple[Colour, ...]] = ((240, 50, 50), (50, 200, 50), (70, 110, 255))
"""Colours of the object's x, y and z axis."""

AXIS: Final = 0.35  # length of a drawn axis, diameters
LINE: Final = 1 / 640  # width of a line, share of the image width
FINEST: Final = 1 / 60
"""Largest width of a line, share of the instance's extent: lines do not hide a small part."""

COLUMNS: Final = ("image", "number", "time", "identity", "object", "score", "frame")
COLUMNS_POSE: Final = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""Columns of :meth:`PoseResult.to_dataframe`."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Diameter and outline mesh of a part, for drawing."""

    diameter: float  # metres
    mesh: OutlineMesh | None  # None if the part has no mesh: only its cuboid is drawn


def make_shape(part: Part) -> Shape:
    """Return the geometry of a part for drawing."""
    mesh = part.mesh
    outline = None if mesh is None else make_outline_mesh(mesh.vertices, mesh.faces)
    return Shape(part.diameter, outline)


@dataclass(frozen=True, eq=False)
class PoseResult:
    """Detections in one frame, with its image and camera matrix."""

    image: RGBImage = field(repr=False)  # RGB, without lens distortion: keypoints and K refer to it
    K: CameraMatrix  # camera matrix, pixels
    detections: Sequence[Detection]  # best score first; from a tracker, sorted by identity
    speed: Mapping[str, float]  # milliseconds of each of STEPS
    name: str  # image file, or source
    number: int = 0  # index in the source, from 0
    time: float | None = None  # seconds since a video's start, or since 1970; None for an image
    identities: Sequence[int] | None = None  # tracked instances; None without a tracker
    shapes: Mapping[str, Shape] = field(default_factory=dict, repr=False)  # by part name
    weaker: Sequence[float] = ()  # scores of the candidates below min_score, best first
    min_score: float = 0.0  # minimum score of a detection
    agreements: Sequence[float] | None = None  # of each drawn part with the image; None: not asked

    @property
    def num_weaker(self) -> int:
        """Number of candidates below :attr:`min_score`."""
        return len(self.weaker)

    @property
    def weaker_in_words(self) -> str:
        """Number of candidates below the threshold as text; empty if there are none."""
        return f"{self.num_weaker} weaker below {self.min_score:.2g}" if self.weaker else ""

    @property
    def summary(self) -> str:
        """Number of poses and of weaker candidates in words."""
        count = len(self.detections)
        poses = f"{count} pose{'s' * (count > 1)}" if count else "nothing found"
        return f"{poses}; {self.weaker_in_words}" if self.weaker else poses

    def plot(self) -> RGBImage:
        """Return the image with every part's silhouette, cuboid, axes, name and score.

        A caption states the number of weaker candidates. Images narrower than 640 pixels are
        enlarged by an integer factor.
        """
        labels = [
            f"{detection.object}{'' if identity is None else f' #{identity}'} {detection.score:.2f}"
            for detection, identity in self._identified()
        ]
        canvas = draw_poses(self.image, self.K, self.detections, labels, self.shapes)
        draw_caption(canvas, self.weaker_in_words)
        return canvas

    def save(self, path: Path | str) -> None:
        """Write :meth:`plot` as PNG or JPEG, according to the suffix.

        Raises:
            UserError: The suffix is neither PNG's nor JPEG's, or the file cannot be written.
        """
        check_target(Path(path), IMAGES)
        write_image(Path(path), self.plot())

    def records(self) -> list[dict[str, Any]]:
        """Return each detection as a dictionary for JSON, with image name, number and time."""
        shared: dict[str, Any] = {"image": self.name, "number": self.number}
        if self.time is not None:
            shared["time"] = self.time
        records = [
            {**shared, **({} if identity is None else {"identity": identity}), **record(detection)}
            for detection, identity in self._identified()
        ]
        if self.agreements is None:
            return records
        pairs = zip(records, self.agreements, strict=True)
        return [{**row, "agreement": agreement} for row, agreement in pairs]

    def to_json(self) -> str:
        """Return image name, K, speed, weaker candidates and all detections as a line of JSON."""
        shared = {"image": self.name, "number": self.number, "time": self.time, "frame": FRAME}
        detections = [
            {key: value for key, value in row.items() if key not in shared}
            for row in self.records()
        ]
        speed = {step: round(ms, 3) for step, ms in self.speed.items()}
        content = {
            **shared,
            "K": self.K.tolist(),
            "speed_ms": speed,
            "min_score": self.min_score,
            "num_weaker": self.num_weaker,
            "best_weaker": max(self.weaker, default=None),
            "detections": detections,
        }
        return json.dumps(content, ensure_ascii=False, allow_nan=False)

    def to_dataframe(self) -> pd.DataFrame:
        """Return a table with one row per detection: position (metres), quaternion (w, x, y, z)."""
        import pandas as pd  # imported on demand, because it is slow to import

        rows = []
        for row, detection in zip(self.records(), self.detections, strict=True):
            T = detection.T_cam_obj
            pose = [*T[:3, 3].tolist(), *matrix_to_quaternion(T[:3, :3]).tolist()]
            rows.append({**row, **dict(zip(COLUMNS_POSE, pose, strict=True))})
        return pd.DataFrame(rows, columns=[*COLUMNS, *COLUMNS_POSE, "reprojection_error_px"])

    def _identified(self) -> list[tuple[Detection, int | None]]:
        """Pair each detection with the tracker's number of its part, or None."""
        identities: Sequence[int | None] = self.identities or [None] * len(self.detections)
        return list(zip(self.detections, identities, strict=True))


def record(detection: Detection) -> dict[str, Any]:
    """Return a detection as a dictionary for JSON, with None for NaN and infinity."""
    return {
        "object": detection.object,
        "score": detection.score,
        "probability": detection.probability,
        "frame": FRAME,
        "T_cam_obj": detection.T_cam_obj.tolist(),
        "covariance": _finite(detection.covariance.tolist()),
        "keypoints": _finite(detection.keypoints.tolist()),
        "reprojection_error_px": _finite(float(detection.reprojection_error_px)),
        "kept": detection.kept or None,
    }


def _finite(value: Any) -> Any:
    """Replace NaN and infinity in nested lists by None."""
    if isinstance(value, list):
        return [_finite(element) for element in value]
    return value if math.isfinite(value) else None


def format_speed(speed: Mapping[str, float]) -> str:
    """Format the milliseconds of each step in one line."""
    return ", ".join(f"{step} {speed.get(step, 0.0):.1f}" for step in STEPS) + " ms"


def elapsed_by_step(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """Return the milliseconds of each step between two copies of ``PoseEstimator.spent_ms``."""
    return {step: after[step] - before[step] for step in STEPS}


def draw_poses(
    image: RGBImage,
    K: CameraMatrix,
    detections: Sequence[Detection],
    labels: Sequence[str],
    shapes: Mapping[str, Shape],
) -> RGBImage:
    """Return a copy of the image with poses and labels, at least ``MIN_WIDTH_PX`` wide."""
    factor = max(1, -(-MIN_WIDTH_PX // image.shape[1]))
    canvas, K = enlarge(image, factor), resize_camera(K, factor, factor)
    tags = []
    for number, (detection, label) in enumerate(zip(detections, labels, strict=True)):
        colour = COLOURS[number % len(COLOURS)]
        keypoints = resize_points(detection.keypoints, factor, factor)
        finite = keypoints[np.isfinite(keypoints).all(axis=1)]
        extent = float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0
        width = max(1, round(min(LINE * canvas.shape[1], math.ceil(FINEST * extent))))
        canvas = draw_wireframe(canvas, keypoints, colour, max(1, width // 2))
        if (shape := shapes.get(detection.object)) is not None:
            for contour in silhouette_contours(shape, detection.T_cam_obj, K, canvas):
                cv2.polylines(canvas, [contour], True, colour, width + 1, cv2.LINE_AA)
            _draw_axes(canvas, detection.T_cam_obj, K, shape.diameter, width + 1)
        left, top = finite.min(axis=0) if len(finite) else (0.0, 0.0)
        tags.append((label, (float(left), float(top)), colour))
    draw_tags(canvas, tags)
    return canvas


def silhouette_contours(
    shape: Shape, T_cam_obj: Transform, K: CameraMatrix, image: RGBImage
) -> list[Int[np.ndarray, "points 1 2"]]:
    """Return the closed contours of a posed mesh on an image, pixels.

    The list is empty without a mesh, or if a vertex is not in front of the camera.
    """
    if shape.mesh is None or (posed_mesh := posed(shape.mesh, T_cam_obj, K)) is None:
        return []
    # One pixel beyond the image, so that no line follows the border where the part is cut off.
    limit = np.array(image.shape[1::-1]) + 2
    low = np.maximum(np.floor(posed_mesh.pixels.min(axis=0)) - 1, -2).astype(int)
    high = np.minimum(np.ceil(posed_mesh.pixels.max(axis=0)) + 2, limit)
    width, height = (high - low).astype(int)
    if min(width, height) <= 0:
        return []
    posed_mesh = posed(shape.mesh, T_cam_obj, crop_camera(K, *low))
    assert posed_mesh is not None
    mask = filled_mask(shape.mesh, posed_mesh, (int(width), int(height)))
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return [np.asarray(contour + low.reshape(1, 1, 2)) for contour in contours]


def _draw_axes(
    canvas: RGBImage, T_cam_obj: Transform, K: CameraMatrix, diameter: float, width: int
) -> None:
    """Draw the object's axes in place, the farthest first."""
    ends = transform(T_cam_obj, np.vstack([np.zeros(3), AXIS * diameter * np.eye(3)]))
    pixels = project(ends, K)
    for axis in np.argsort(-ends[1:, 2]).tolist():
        draw_line(canvas, pixels[0], pixels[1 + axis], AXES[axis], width)
