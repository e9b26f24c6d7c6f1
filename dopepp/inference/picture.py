"""The picture a caller gives: checked, a region of it cut out, and as the network takes it."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import (
    ANYWHERE,
    WHOLE,
    CameraMatrix,
    Letterbox,
    check_camera,
    crop_camera,
)
from dopepp.inference.refinement.view import Coefficients

Region = tuple[int, int, int, int]
"""x, y, width and height, pixels."""


def checked_picture(
    image: Picture, K: CameraMatrix, cropped: bool = False
) -> tuple[Picture, CameraMatrix]:
    """Check that the arguments are an RGB image and its camera matrix; a UserError if not.

    The principal point of one that was ``cropped`` may lie anywhere.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise UserError(
            f"an image of shape {image.shape} and type {image.dtype}",
            "(height, width, 3) uint8 in RGB order",
            "convert the image, e.g. cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)",
        )
    # Flipped views, as of bgr[..., ::-1], have strides that OpenCV and torch do not take.
    size, off_centre = (image.shape[1], image.shape[0]), ANYWHERE if cropped else WHOLE
    return np.ascontiguousarray(image), check_camera(K, size, "predict", off_centre)


def checked_distortion(distortion: Coefficients) -> Coefficients:
    """Check that the coefficients are those of one of OpenCV's lens models."""
    coefficients = np.asarray(distortion, np.float64).ravel()
    if coefficients.size not in (4, 5, 8, 12, 14) or not np.isfinite(coefficients).all():
        raise UserError(
            f"distortion {coefficients.tolist()!s:.200}",
            "4, 5, 8, 12 or 14 finite numbers in OpenCV's order (k1, k2, p1, p2, k3, …)",
            "pass the camera's calibration, or None for an undistorted image",
        )
    return coefficients


def cut(
    image: Picture, K: CameraMatrix, roi: Region | None
) -> tuple[Picture, CameraMatrix, tuple[int, int]]:
    """Return a region of an image, its K and its upper left corner, pixels."""
    if roi is None:
        return image, K, (0, 0)
    height, width = image.shape[:2]
    x, y, columns, rows = (round(one) for one in roi)
    if not (0 <= x < x + columns <= width and 0 <= y < y + rows <= height):
        allowed = f"(x, y, width, height) within the {width}×{height} image, pixels"
        raise UserError(f"roi {tuple(roi)}", allowed, "cut it to the image")
    window = np.ascontiguousarray(image[y : y + rows, x : x + columns])
    return window, crop_camera(K, x, y), (x, y)


def letterboxed(
    image: Picture, letterbox: Letterbox, multiple: int
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Resize an image into a letterbox and pad it, right and bottom, to a multiple."""
    image = letterbox.image(image)
    rows, columns = -image.shape[0] % multiple, -image.shape[1] % multiple
    return np.pad(image, ((0, rows), (0, columns), (0, 0)))
