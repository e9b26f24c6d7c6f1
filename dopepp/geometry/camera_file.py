"""Camera files: the calibration of a lens, in the format of the tool that wrote it.

Formats are ROS ``camera_info`` (from a calibration or an echoed message), OpenCV's FileStorage
(YAML, XML, JSON), BOP's ``camera.json``, NDDS's ``_camera_settings.json``, COLMAP's ``cameras.txt``
and plain text with 3×3 or four numbers; see :mod:`dopepp.geometry.camera_formats`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from dopepp.core.errors import UserError
from dopepp.core.files import read_limited
from dopepp.geometry.camera import (
    ANYWHERE,
    WHOLE,
    CameraMatrix,
    check_camera,
    crop_camera,
    pinhole_matrix,
    resize_camera,
)
from dopepp.geometry.camera_formats import (
    FORMATS,
    Calibration,
    Size,
    calibration_of_fields,
    parse_calibration,
)

Crop = tuple[int, int, int, int]  # x and y of the upper left pixel, width and height, pixels

MAX_BYTES: Final = 250_000
"""Largest size of a camera file, more than any calibration; parsing as much YAML takes 10 s."""

COEFFICIENTS: Final = (0, 4, 5, 8, 12, 14)  # Numbers of coefficients of OpenCV's lens models


@dataclass(frozen=True, eq=False)
class Camera:
    """Calibrated pinhole camera with OpenCV's lens distortion.

    Attributes:
        size: (width, height) of the calibrated images, pixels; None if unknown.
        K: Camera matrix, pixels.
        distortion: Coefficients in OpenCV's order (k1, k2, p1, p2, k3, …), or ().
        source: Origin, for messages.
        cropped: Whether the images are crops, with the principal point anywhere.
    """

    size: Size | None
    K: CameraMatrix
    distortion: tuple[float, ...]
    source: str
    cropped: bool = False

    @property
    def coefficients(self) -> Float[np.ndarray, "coefficients"] | None:
        """Distortion coefficients for OpenCV and ``PoseEstimator.predict``, or None."""
        return np.array(self.distortion) if self.distortion else None

    def undistorted(
        self, image: UInt8[np.ndarray, "height width 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Return an image of this camera without distortion, with the same K."""
        if self.coefficients is None:
            return image
        return np.asarray(cv2.undistort(image, self.K, self.coefficients))

    def for_picture(
        self, size: Size, K_size: Size | None = None, crop: Crop | None = None
    ) -> Camera:
        """Return the camera of an image, after checking K against the image's size.

        ``K_size`` is the size of the calibrated image if this image was resized, and ``crop`` the
        region of the calibrated image if this image is a crop.

        Raises:
            UserError: K belongs to another size, which neither ``K_size`` nor ``crop`` explains, or
                an option is invalid.
        """
        if K_size is not None and crop is not None:
            problem, fix = "--K-size with --crop", "crop first, and pass the K of the crop's size"
            raise UserError(problem, "only one of them", fix)
        if K_size is not None:
            stated = f"--K-size {K_size[0]} {K_size[1]}"
            if min(K_size) < 1:
                fix = "pass the size of the calibrated image, e.g. --K-size 1920 1080"
                raise UserError(stated, "width and height above 0", fix)
            if self.size is not None and K_size != self.size:
                allowed = f"the file's own size, {_size_text(self.size)}"
                fix = f"leave out --K-size, or pass --K-size {self.size[0]} {self.size[1]}"
                raise UserError(f"{stated} with {self.source}", allowed, fix)
        calibrated, off_centre = K_size or self.size, ANYWHERE if self.cropped else WHOLE
        if calibrated is not None:
            check_camera(self.K, calibrated, self.source, off_centre)
        if crop is not None:
            K = _check_and_crop(self.K, calibrated, size, crop)
            K = check_camera(K, size, self.source, ANYWHERE)
        elif calibrated is None or calibrated == size:
            K = check_camera(self.K, size, self.source, off_centre)
        elif K_size is None or not _equal_aspect(size, calibrated):
            problem = f"{self.source}, whose K is for {_size_text(calibrated)}"
            problem += f", with an image of {_size_text(size)}"
            allowed = "K for the image's size, or an option that explains the difference"
            raise UserError(problem, allowed, _fix(size, calibrated))
        else:
            K = resize_camera(self.K, size[0] / calibrated[0], size[1] / calibrated[1])
        return replace(self, size=size, K=K)


def read_camera(path: Path | str) -> Camera:
    """Read a camera file in one of the formats of this module.

    K of COLMAP, which puts the centre of the top-left pixel at (0.5, 0.5), is shifted by half a
    pixel.

    Raises:
        UserError: The file is missing, over 250 kB or in an unknown format, describes several
            cameras or a fisheye lens, lacks the camera matrix, or has an invalid field.
    """
    return camera_of_text(_read_text(Path(path)), str(path))


def camera_of_text(text: str, source: str) -> Camera:
    """Like :func:`read_camera`, for the text of a file."""
    return _camera(parse_calibration(text, source), source)


def camera_of_fields(fields: Mapping[str, object], source: str) -> Camera:
    """Like :func:`read_camera`, for named fields, e.g. of a ROS message."""
    return _camera(calibration_of_fields(fields, source), source)


def _camera(calibration: Calibration, source: str) -> Camera:
    """Return a calibration's camera, after checking K and the number of distortion coefficients."""
    size, K, lens = calibration
    K = pinhole_matrix(K, source)
    if min(K[0, 0], K[1, 1]) <= 0:
        problem = f"{source}: fx={K[0, 0]:g}, fy={K[1, 1]:g}"
        fix = "calibrate the camera, e.g. with `dopepp calibrate camera`"
        raise UserError(problem, "focal lengths above 0 pixels", fix)
    if len(lens) not in COEFFICIENTS:
        problem = f"{source}: {len(lens)} distortion coefficients"
        allowed = f"{', '.join(map(str, COEFFICIENTS))} in OpenCV's order (k1, k2, p1, p2, k3, …)"
        raise UserError(problem, allowed, "add zeros for the missing coefficients")
    return Camera(size, K, lens if any(lens) else (), source)


def _read_text(path: Path) -> str:
    """Return the text of a UTF-8 file of at most ``MAX_BYTES``."""
    try:
        return read_limited(path, MAX_BYTES).decode("utf-8-sig").strip()
    except (OSError, ValueError) as error:  # ValueError also for a null character in its name
        problem = f"camera file {path!s:.200}: {getattr(error, 'strerror', None) or error}"
        allowed = f"a UTF-8 camera file of at most {MAX_BYTES / 1e3:g} kB: {FORMATS}"
        raise UserError(problem, allowed, "pass a file in one of these formats") from error


def _check_and_crop(
    K: CameraMatrix, calibrated: Size | None, size: Size, crop: Crop
) -> CameraMatrix:
    """Check a crop against the sizes of the image and the calibrated image; return the crop's K."""
    x, y, width, height = crop
    stated = "--crop " + " ".join(map(str, crop))
    if (width, height) != size:
        problem = f"{stated} with an image of {_size_text(size)}"
        fix = f"pass --crop {x} {y} {size[0]} {size[1]}"
        raise UserError(problem, "x y followed by the image's width and height", fix)
    exceeds = calibrated is not None and (x + width > calibrated[0] or y + height > calibrated[1])
    if min(x, y) < 0 or exceeds:
        inside = "inside the calibrated image"
        inside += f" of {_size_text(calibrated)}" if calibrated else ""
        fix = "pass the position of the crop in the calibrated image"
        raise UserError(stated, f"x y width height {inside}", fix)
    return crop_camera(K, x, y)


def _equal_aspect(a: Size, b: Size) -> bool:
    """Return whether the aspect ratios of two sizes are equal, up to rounding to whole pixels."""
    return min(abs(a[0] - a[1] * b[0] / b[1]), abs(a[1] - a[0] * b[1] / b[0])) <= 1


def _fix(size: Size, calibrated: Size) -> str:
    """Return advice for an image whose size differs from the calibrated size."""
    fits = size[0] <= calibrated[0] and size[1] <= calibrated[1]
    cut = f"--crop X Y {size[0]} {size[1]} if it was cropped" if fits else ""
    if _equal_aspect(size, calibrated):
        resized = f"--K-size {calibrated[0]} {calibrated[1]} if the image was resized"
        return f"{resized}, {cut}" if cut else resized
    if size == calibrated[::-1]:
        return "rotate the image back, or calibrate rotated images (EXIF orientation is applied)"
    return cut or f"calibrate the camera at {_size_text(size)}"


def _size_text(size: Size) -> str:
    """Format a size as ``width×height``."""
    return f"{size[0]}×{size[1]}"
