"""Camera files: what a calibration says of a lens, in whichever format its tool wrote it.

Read are ROS ``camera_info`` (as calibration writes it, or as a message is echoed), OpenCV's
FileStorage (YAML, XML, JSON), BOP's ``camera.json``, NDDS's ``_camera_settings.json``, COLMAP's
``cameras.txt`` and plain text with 3×3 or four numbers. The content tells which, not the suffix.
A file may come from anybody, so none is given to ``cv2.FileStorage``, which is C++.

To read a further format, see the modules of :mod:`dopepp.geometry.camera_files`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.geometry.camera import CameraMatrix, pinhole_matrix
from dopepp.geometry.camera_files.fields import read_fields
from dopepp.geometry.camera_files.numbers import read_lines
from dopepp.geometry.camera_files.values import FORMATS, Size

MAX_BYTES: Final = 250_000
"""A calibration with all the points it was made of takes less; YAML of this size takes 10 s."""

COEFFICIENTS: Final = (0, 4, 5, 8, 12, 14)
"""How many OpenCV's lens models have."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera.

    Attributes:
        size: (width, height) of the pictures that K belongs to, pixels; None where nobody says.
        K: The camera matrix, pixels; (0, 0) is the centre of the top-left pixel.
        distortion: Coefficients in OpenCV's order (k1, k2, p1, p2, k3, …); () where there is none.
        source: Where it comes from, for messages.
    """

    size: Size | None
    K: CameraMatrix
    distortion: tuple[float, ...]
    source: str


def read_camera(path: Path | str) -> Camera:
    """Read a camera file; see the module for the formats.

    COLMAP, whose pixel (0.5, 0.5) is the centre of the top-left one, is shifted by half a pixel.

    Raises:
        UserError: The file is missing, over 250 kB, in none of the formats, or of several cameras;
            it has no camera matrix, a lens model that is not OpenCV's pinhole one (fisheye), or a
            field that cannot be right.
    """
    path = Path(path)
    text = _text(path)
    found = read_lines(text, path) or read_fields(text, path)
    K = pinhole_matrix(found.K, str(path))
    if min(K[0, 0], K[1, 1]) <= 0:
        raise UserError(
            f"{path}: fx={K[0, 0]:g}, fy={K[1, 1]:g}",
            "focal lengths above 0 pixels",
            "calibrate the camera: this file is of one that was not",
        )
    if len(found.distortion) not in COEFFICIENTS:
        counts = ", ".join(map(str, COEFFICIENTS))
        raise UserError(
            f"{path}: {len(found.distortion)} distortion coefficients",
            f"{counts} in OpenCV's order (k1, k2, p1, p2, k3, …)",
            "add zeros for those that the calibration left out",
        )
    lens = found.distortion if any(found.distortion) else ()
    return Camera(found.size, K, lens, str(path))


def _text(path: Path) -> str:
    """Return a file's text, within bounds."""
    allowed = f"a camera file of at most {MAX_BYTES / 1e3:g} kB: {FORMATS}"
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise UserError(f"camera file {path}: {error.strerror}", allowed, "check it") from error
    except ValueError as error:  # a null character in its name
        raise UserError(f"camera file {path!s:.200}: {error}", allowed, "check it") from error
    if len(content) > MAX_BYTES:
        size = f"more than {MAX_BYTES / 1e3:g} kB"
        raise UserError(f"camera file {path} of {size}", allowed, "pass the camera's file")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        got = f"camera file {path}: byte {error.start} is no UTF-8"
        raise UserError(got, allowed, "pass the camera's file") from error
    return text.strip()
