"""Camera calibration from images of a board (Zhang 2000, by OpenCV), and its quality."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import yaml
from jaxtyping import Bool, Float

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, write_file
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera_file import Camera
from dopepp.robot.calibration.board import MIN_POINTS, BoardDetection

MIN_VIEWS: Final = 6  # smallest number of views of a reliable calibration; 3 views determine K
CELLS: Final = (8, 6)  # columns and rows of the grid that measures the coverage
MIN_COVERAGE: Final = 0.5
# Standard deviation of the boards' normals, about 12°. Smaller tilts do not separate the focal
# length from the distance.
MIN_TILT: Final = 0.2
MAX_ERROR_PX: Final = 1.0
OUTLIER: Final = 3.0  # smallest error of a rejected view, as a multiple of the median error
MIN_OUTLIER_PX: Final = 0.5
MIN_SHIFT: Final = 0.04  # mean shift of points between distinct views, share of the image's width
MAX_VIEWS: Final = 60
CHECKS_PER_S: Final = 5.0  # frames of a video in which the board is searched, per second


class Views:
    """Distinct views of a board, whose points are shifted by 4 % of the image width (pixels).

    Of similar views, the view with the smallest shift from the previous frame is kept, so that
    sharp frames of a video replace frames with motion blur.
    """

    def __init__(self, width: int) -> None:
        self.kept: list[BoardDetection] = []
        self._limit = MIN_SHIFT * width
        self._motions: list[float] = []
        self._last: BoardDetection | None = None

    def add(self, detection: BoardDetection) -> bool:
        """Add the next frame's detection; return whether it differs from all views kept so far."""
        motion = np.inf if self._last is None else _shift(self._last, detection)
        self._last = detection
        shifts = [_shift(view, detection) for view in self.kept]
        nearest = int(np.argmin(shifts)) if shifts else 0
        if not shifts or shifts[nearest] > self._limit:
            self.kept.append(detection)
            self._motions.append(motion)
            return True
        if motion < self._motions[nearest]:
            self.kept[nearest], self._motions[nearest] = detection, motion
        return False

    @property
    def is_full(self) -> bool:
        """Whether 60 views are kept; further views hardly improve a calibration."""
        return len(self.kept) >= MAX_VIEWS


def _shift(first: BoardDetection, second: BoardDetection) -> float:
    """Return the mean shift of the common points in pixels, or inf for fewer than 8 points."""
    is_same = (first.points[:, None] == second.points[None]).all(axis=2)
    rows, columns = np.nonzero(is_same)
    if len(rows) < MIN_POINTS:
        return np.inf
    return float(np.linalg.norm(first.pixels[rows] - second.pixels[columns], axis=1).mean())


@dataclass(frozen=True, eq=False)
class LensCalibration:
    """Intrinsics of a camera from images of a board, and measures of their quality."""

    camera: Camera
    error_px: float  # RMS reprojection error over all used views
    names: tuple[str, ...]  # image of each view used in the calibration
    errors_px: Float[np.ndarray, "views"]  # RMS reprojection error of each view
    outliers: tuple[str, ...]  # names of views rejected for large errors
    coverage: float  # share of the 8×6 image cells that contain a detected point, 0 to 1
    covered: Bool[np.ndarray, "rows columns"]  # image cells that contain a detected point
    deviations: Float[np.ndarray, "4"]  # standard deviations of fx, fy, cx, cy, pixels
    findings: tuple[str, ...]  # reasons not to trust the calibration, with remedies


def calibrate_lens(detections: Sequence[BoardDetection], size: Size) -> LensCalibration:
    """Estimate a camera's intrinsics and lens distortion from views of a board.

    Views with a reprojection error above 0.5 px and 3 times the median are rejected once.

    Raises:
        UserError: There are fewer than three views, or OpenCV cannot solve for the camera.
    """
    if len(detections) < 3:
        raise UserError(
            f"{len(detections)} images with the board",
            f"at least 3, better {MIN_VIEWS} or more",
            "take more images, with the board tilted by 20 to 40° in all directions and moved "
            "into the corners of the image",
        )
    calibration = _calibrate(detections, size)
    errors_px = calibration.errors_px
    is_kept = errors_px <= max(MIN_OUTLIER_PX, OUTLIER * float(np.median(errors_px)))
    if is_kept.all() or is_kept.sum() < 3:
        return calibration
    views = [view for view, keep in zip(detections, is_kept, strict=True) if keep]
    outliers = (view.name for view, keep in zip(detections, is_kept, strict=True) if not keep)
    return replace(_calibrate(views, size), outliers=tuple(outliers))


def _calibrate(views: Sequence[BoardDetection], size: Size) -> LensCalibration:
    """Calibrate the camera with OpenCV from all views, without rejection of outliers."""
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    num_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # threads add up in random order, and the result would differ every time
    try:
        error_px, K, lens, rotations, _, deviations, _, errors_px = cv2.calibrateCameraExtended(
            points, pixels, size, None, None
        )
    except cv2.error as reason:
        problem = f"{len(views)} views of the board, which do not determine a camera ({reason.err})"
        allowed = "views tilted by 20 to 40° in several directions"
        raise UserError(problem, allowed, "take more images of the tilted board") from reason
    finally:
        cv2.setNumThreads(num_threads)
    normals = np.array([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    tilt = float(np.linalg.norm(normals[:, :2].std(axis=0)))
    x, y = np.concatenate([view.pixels for view in views]).T
    borders = ((-0.5, size[1] - 0.5), (-0.5, size[0] - 0.5))
    covered = np.histogram2d(y, x, CELLS[::-1], borders)[0] > 0
    coverage = float(covered.mean())
    return LensCalibration(
        Camera(size, np.asarray(K), tuple(np.ravel(lens)[:5].tolist()), "calibration"),
        float(error_px),
        tuple(view.name for view in views),
        np.ravel(errors_px),
        (),
        coverage,
        covered,
        np.ravel(deviations)[:4],
        _findings(len(views), coverage, tilt, float(error_px)),
    )


def write_camera(path: Path, camera: Camera, trusted: bool = True) -> None:
    """Write a camera as ROS's ``camera_info`` YAML, with a warning in it unless ``trusted``."""
    check_target(path, (".yaml", ".yml"))
    assert camera.size is not None
    lens = list(camera.distortion)
    content = {
        "image_width": camera.size[0],
        "image_height": camera.size[1],
        "camera_name": "camera",
        "camera_matrix": _matrix(camera.K),
        "distortion_model": "rational_polynomial" if len(lens) > 5 else "plumb_bob",
        "distortion_coefficients": _matrix(np.array([lens or [0.0] * 5])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.hstack([camera.K, np.zeros((3, 1))])),
    }
    remark = "" if trusted else "# NOT TRUSTED: written with --force; see the report\n"
    text = remark + yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    write_file(path, text.encode())


def _matrix(values: Float[np.ndarray, "rows columns"]) -> dict[str, object]:
    """Return a matrix in the layout of OpenCV's and ROS's YAML files."""
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": np.float64(values).ravel().tolist()}


def _findings(num_views: int, coverage: float, tilt: float, error_px: float) -> tuple[str, ...]:
    """Return reasons not to trust a calibration; for ``tilt``, see :data:`MIN_TILT`."""
    findings = {
        f"only {num_views} views: take at least {MIN_VIEWS}": num_views < MIN_VIEWS,
        f"points cover {coverage:.0%} of the image: move the board to its borders and corners, "
        "also close to the camera": coverage < MIN_COVERAGE,
        "the board is almost parallel in all views, which leaves the focal length uncertain: "
        "tilt it by 20 to 40° to the left, right, up and down": tilt < MIN_TILT,
        f"the reprojection error is {error_px:.2f} px: check that the board is flat, in focus and "
        "of the stated size": error_px > MAX_ERROR_PX,
    }
    return tuple(text for text, applies in findings.items() if applies)
