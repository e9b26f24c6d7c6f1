"""What every camera file says in the end, and the checks of its single values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from dopepp.core.errors import UserError
from dopepp.geometry.camera import CameraMatrix, camera_matrix, pinhole_matrix

Size = tuple[int, int]
"""(width, height), pixels."""

MAX_SIDE: Final = 65_536
"""Pixels of a calibrated picture's side."""

FORMATS: Final = (
    "ROS camera_info, OpenCV FileStorage, BOP camera.json, COLMAP cameras.txt, "
    "3×3 numbers, or the four numbers fx fy cx cy"
)
UNDISTORT: Final = "undistort the pictures and pass the K of the undistorted ones"


class Calibration(NamedTuple):
    """A picture's (width, height), where it is said; K; coefficients in OpenCV's order."""

    size: Size | None
    K: CameraMatrix
    distortion: tuple[float, ...] = ()


def matrix(values: Sequence[float], where: Path | str) -> CameraMatrix:
    """Make a camera matrix of nine numbers, row by row, or of fx, fy, cx, cy."""
    if len(values) == 4:
        fx, fy, cx, cy = values
    elif len(values) == 9:
        return pinhole_matrix([values[:3], values[3:6], values[6:]], str(where))  # type: ignore[arg-type]
    else:
        raise UserError(
            f"{where}: {len(values)} numbers",
            "nine (K, row by row) or four (fx fy cx cy)",
            "write K as 3×3 numbers",
        )
    return camera_matrix(fx, fy, cx, cy)


def is_number(value: object) -> bool:
    """Tell whether a value, or the text of one, is a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return False
    try:
        return math.isfinite(float(value))
    except (ValueError, OverflowError):
        return False


def side_px(value: object, where: str) -> int:
    """Return a picture's side, pixels."""
    if not is_number(value) or not 1 <= (side := float(value)) <= MAX_SIDE or side % 1:  # type: ignore[arg-type]
        allowed = f"a whole number of pixels from 1 to {MAX_SIDE}"
        raise UserError(f"{where}={shown(value)}", allowed, "correct it or leave the size out")
    return int(side)


def shown(value: object) -> str:
    """Return a value for a message, which of an endless integer has only its type."""
    try:
        return f"{value!r:.80}"
    except ValueError:
        return type(value).__name__
