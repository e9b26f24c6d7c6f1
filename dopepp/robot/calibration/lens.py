"""A camera's lens from pictures of a board (Zhang 2000, by OpenCV), and whether to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import yaml
from jaxtyping import Bool, Float

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, write_whole
from dopepp.geometry.camera_file import Camera
from dopepp.robot.calibration.board import MIN_POINTS, Sighting

Size = tuple[int, int]

MIN_VIEWS: Final = 6  # of a trustworthy calibration; three would give a K
CELLS: Final = (8, 6)  # of a picture, columns and rows, in which points are counted
MIN_COVERAGE: Final = 0.5
MIN_TILT: Final = 0.2
"""Standard deviation of the boards' normals: about 12°, from which on focal length and distance
are told from each other."""

MAX_ERROR_PX: Final = 1.0
OUTLIER: Final = 3.0  # times the median view's error, from which on a view is left out
LEAST_OUTLIER_PX: Final = 0.5

APART: Final = 0.04
"""Mean shift of a board's points between two views that differ, share of the picture's width."""

MAX_VIEWS: Final = 60
LOOKS_PER_S: Final = 5.0  # how often a video is looked at


class Views:
    """Keeps the views that differ; of those that do not, the one in which the board moved least.

    So a video is worth its pauses: what is blurred by motion gives way to what is not.
    """

    def __init__(self, width: int) -> None:
        self.kept: list[Sighting] = []
        self._limit = APART * width
        self._motions: list[float] = []
        self._last: Sighting | None = None

    def offer(self, sighting: Sighting) -> bool:
        """Take the next sighting; tell whether it is a new view."""
        motion = np.inf if self._last is None else _shift(self._last, sighting)
        self._last = sighting
        shifts = [_shift(one, sighting) for one in self.kept]
        nearest = int(np.argmin(shifts)) if shifts else 0
        if not shifts or shifts[nearest] > self._limit:
            self.kept.append(sighting)
            self._motions.append(motion)
            return True
        if motion < self._motions[nearest]:
            self.kept[nearest], self._motions[nearest] = sighting, motion
        return False

    @property
    def is_full(self) -> bool:
        """Whether more views would cost time only."""
        return len(self.kept) >= MAX_VIEWS


def _shift(one: Sighting, other: Sighting) -> float:
    """Return the mean distance between the points that both show, pixels; infinite if too few."""
    same = (one.points[:, None] == other.points[None]).all(axis=2)
    first, second = np.nonzero(same)
    if len(first) < MIN_POINTS:
        return np.inf
    return float(np.linalg.norm(one.pixels[first] - other.pixels[second], axis=1).mean())


@dataclass(frozen=True, eq=False)
class LensCalibration:
    """A lens and what it was made of."""

    camera: Camera  # the calibrated camera
    error_px: float  # RMS reprojection error over all views kept, pixels
    names: tuple[str, ...]  # of the views
    errors_px: Float[np.ndarray, "views"]  # the RMS reprojection error of each, pixels
    # Names of views that were left out, since they are far worse than the others.
    outliers: tuple[str, ...]
    coverage: float  # share of the picture's cells (8×6) in which points were seen
    covered: Bool[np.ndarray, "rows columns"]  # which cells these are
    deviations: Float[np.ndarray, "4"]  # standard deviations of fx, fy, cx, cy, pixels
    findings: tuple[str, ...]  # why it is not to be trusted, and what to do; empty where it is


def calibrate_lens(sightings: Sequence[Sighting], size: Size) -> LensCalibration:
    """Calibrate a camera from views of a board in pictures of (width, height).

    Views that are far worse than the others are left out, once. A :class:`UserError`: there are
    fewer than three views, or nothing comes out of them.
    """
    if len(sightings) < 3:
        raise UserError(
            f"{len(sightings)} pictures with the board",
            f"at least 3, better {MIN_VIEWS} or more",
            "take further ones, tilted by 20 to 40° in all directions and out to the corners",
        )
    kept, outliers = list(sightings), []
    lens = _solved(kept, size)
    limit = max(LEAST_OUTLIER_PX, OUTLIER * float(np.median(lens[4])))
    bad = lens[4] > limit
    if bad.any() and (~bad).sum() >= 3:
        outliers = [one.name for one, out in zip(kept, bad, strict=True) if out]
        kept = [one for one, out in zip(kept, bad, strict=True) if not out]
        lens = _solved(kept, size)
    error, K, distortion, deviations, errors, tilt = lens
    covered = _covered(kept, size)
    camera = Camera(size, K, tuple(distortion.tolist()), "calibration")
    coverage = float(covered.mean())
    findings = _findings(len(kept), coverage, tilt, error)
    names = tuple(one.name for one in kept)
    return LensCalibration(
        camera, error, names, errors, tuple(outliers), coverage, covered, deviations, findings
    )


def write_camera(path: Path, camera: Camera, trusted: bool = True, name: str = "camera") -> None:
    """Write a camera as ROS's ``camera_info`` YAML, which every ``--camera`` reads."""
    check_target(path, (".yaml", ".yml"))
    assert camera.size is not None
    K = camera.K
    P = np.hstack([K, np.zeros((3, 1))])
    lens = list(camera.distortion)
    content = {
        "image_width": camera.size[0],
        "image_height": camera.size[1],
        "camera_name": name,
        "camera_matrix": _matrix(K),
        "distortion_model": "rational_polynomial" if len(lens) > 5 else "plumb_bob",
        "distortion_coefficients": _matrix(np.array([lens or [0.0] * 5])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(P),
    }
    remark = "" if trusted else "# NOT TRUSTED: written with --force; see the report\n"
    text = remark + yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    write_whole(path, text.encode())


def _matrix(values: Float[np.ndarray, "rows columns"]) -> dict[str, object]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": [float(one) for one in values.ravel()]}


def _solved(
    views: Sequence[Sighting], size: Size
) -> tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, "5"], Float[np.ndarray, "4"],
           Float[np.ndarray, "views"], float]:  # fmt: skip
    """Return error, K, distortion, deviations of K, error of each view, and how tilts vary."""
    points = [one.points.astype(np.float32) for one in views]
    pixels = [one.pixels.astype(np.float32) for one in views]
    try:
        error, K, lens, turns, _, deviations, _, errors = cv2.calibrateCameraExtended(
            points, pixels, size, None, None
        )
    except cv2.error as reason:
        raise UserError(
            f"{len(views)} views of the board, from which no camera follows ({reason.err})",
            "views tilted by 20 to 40° in several directions", "take further ones",
        ) from reason  # fmt: skip
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    tilt = float(np.linalg.norm(normals[:, :2].std(axis=0)))
    return (
        float(error), np.asarray(K), np.ravel(lens)[:5], np.ravel(deviations)[:4],
        np.ravel(errors), tilt,
    )  # fmt: skip


def _covered(views: Sequence[Sighting], size: Size) -> Bool[np.ndarray, "rows columns"]:
    pixels = np.concatenate([one.pixels for one in views])
    edges = [np.linspace(-0.5, side - 0.5, count + 1) for side, count in zip(size, CELLS)]  # noqa: B905
    counts, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=(edges[1], edges[0]))
    return np.asarray(counts > 0)


def _findings(views: int, coverage: float, tilt: float, error: float) -> tuple[str, ...]:
    """Return why a calibration is not to be trusted."""
    found = []
    if views < MIN_VIEWS:
        found.append(f"only {views} views: take at least {MIN_VIEWS}")
    if coverage < MIN_COVERAGE:
        found.append(
            f"points cover {coverage:.0%} of the picture: bring the board to its borders and "
            "corners, from near as well"
        )
    if tilt < MIN_TILT:
        found.append(
            "the board was held almost parallel in all views, which leaves the focal length open: "
            "tilt it by 20 to 40° to the left, right, up and down"
        )
    if error > MAX_ERROR_PX:
        found.append(
            f"points are {error:.2f} px off: is the board flat, of the stated size, in focus?"
        )
    return tuple(found)
