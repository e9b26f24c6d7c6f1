"""The image, depth image and region that a caller passes: types, checks and lens distortion."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32

from dopepp.core.errors import UserError
from dopepp.core.validation import Span
from dopepp.drawing.pictures import RGBImage, Size, read_image
from dopepp.geometry.camera import ANYWHERE, WHOLE, CameraMatrix, check_camera

Region = tuple[int, int, int, int]  # x, y, width and height, pixels

Distances = tuple[float, float] | Literal["any"]
"""Nearest and farthest depth, metres; ``any``: all depths at which the network detects parts."""

Depth = Float[np.ndarray, "height width"]
Depth32 = Float32[np.ndarray, "height width"]  # metres along z of every pixel

Coefficients = Float[np.ndarray, "coefficients"]  # lens distortion, in OpenCV's order

FARTHEST: Final = 50.0
"""Median above which a depth image is rejected, metres: its values are probably millimetres."""

METRES: Final = Span(0.001, 1000.0, "metres")  # valid distances


def prepare_image(
    image: RGBImage,
    K: CameraMatrix,
    distortion: Coefficients | None = None,
    depth: Depth | None = None,
    cropped: bool = False,
) -> tuple[RGBImage, CameraMatrix, Depth32 | None]:
    """Check the arguments of a prediction and remove the lens distortion.

    Args:
        image: RGB, uint8.
        K: Camera matrix, pixels.
        distortion: OpenCV's distortion coefficients of image and depth; None: undistorted images.
        depth: Metres along z, aligned to the image.
        cropped: Whether the image may be a crop, with the principal point anywhere.

    Returns:
        Image, K and depth, without distortion.

    Raises:
        UserError: An argument is invalid, or K or depth do not belong to the image.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise UserError(
            f"an image of shape {image.shape} and type {image.dtype}",
            "(height, width, 3) uint8 in RGB order",
            "convert the image, e.g. cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)",
        )
    # Flipped views, e.g. bgr[..., ::-1], have strides that OpenCV and torch do not accept.
    image, size = np.ascontiguousarray(image), (image.shape[1], image.shape[0])
    K = check_camera(K, size, "predict", ANYWHERE if cropped else WHOLE)
    checked = None if depth is None else check_depth(depth, size)
    if distortion is None:
        return image, K, checked
    coefficients = np.asarray(distortion, np.float64).ravel()
    if coefficients.size not in (4, 5, 8, 12, 14) or not np.isfinite(coefficients).all():
        raise UserError(
            f"distortion {coefficients.tolist()!s:.200}",
            "4, 5, 8, 12 or 14 finite numbers in OpenCV's order (k1, k2, p1, p2, k3, …)",
            "pass the camera's calibration, or None for an undistorted image",
        )
    checked = None if checked is None else undistort_depth(checked, K, coefficients)
    return cv2.undistort(image, K, coefficients), K, checked


def check_depth(depth: Depth, image_size: Size) -> Depth32:
    """Return depth as float32, with 0 where it is unknown (0, NaN or infinite).

    Args:
        depth: Metres along z.
        image_size: (width, height) of the colour image.

    Raises:
        UserError: The depth is not aligned to the image, not an array of floats, negative, or
            implausible in metres.
    """
    depth = np.asarray(depth)
    if depth.shape != image_size[::-1]:
        raise UserError(
            f"depth of shape {depth.shape} for an image of {image_size[0]}×{image_size[1]}",
            f"one value per pixel, shape {image_size[::-1]}",
            "align the depth to the colour image first",
        )
    if not np.issubdtype(depth.dtype, np.floating):
        fix = "convert it, e.g. depth.astype('float32') / 1000 for millimetres"
        raise UserError(f"depth of type {depth.dtype}", "floats in metres", fix)
    depth = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    measured = depth[depth != 0]
    if measured.size and measured.min() < 0:
        problem = f"depth with values down to {measured.min():.4g}"
        fix = "read the depth as unsigned numbers, and set unknown pixels to 0"
        raise UserError(problem, "metres along z, 0 where unknown", fix)
    if measured.size and np.median(measured) > FARTHEST:
        raise UserError(
            f"depth with a median of {np.median(measured):.4g} m",
            f"metres, a median of at most {FARTHEST:g}",
            "divide by 1000 if it is in millimetres (or by the camera's own depth scale)",
        )
    return depth


def read_depth_image(path: Path, scale: float) -> Depth32:
    """Read a 16-bit PNG as depth in metres, 0 where unknown.

    Args:
        path: PNG file.
        scale: Metres per unit.

    Raises:
        UserError: The scale is not positive, or the file is no 16-bit image of one channel.
    """
    if not 0 < scale < np.inf:
        fix = "pass 0.001 for millimetres"
        raise UserError(f"depth scale {scale}", "metres per unit, above 0", fix)
    units = read_image(path)
    if units.dtype != np.uint16 or units.ndim != 2:
        raise UserError(
            f"depth image {path} of type {units.dtype} and shape {units.shape}",
            "a PNG with one channel of 16 bits",
            "save the raw depth, not a coloured image of it",
        )
    return (units * scale).astype(np.float32)


def undistort_depth(depth: Depth32, K: CameraMatrix, distortion: Coefficients) -> Depth32:
    """Undistort a depth image.

    Nearest-neighbour interpolation is used, because the mean of depths on both sides of an edge is
    the depth of neither surface.

    Args:
        depth: Depth image, metres.
        K: Camera matrix of the input and the output, pixels.
        distortion: Distortion coefficients in OpenCV's order.
    """
    size = depth.shape[::-1]
    maps = cv2.initUndistortRectifyMap(K, distortion, np.eye(3), K, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(depth, *maps, cv2.INTER_NEAREST), np.float32)


def check_region(roi: Region | None, image: RGBImage) -> Region | None:
    """Return a region of an image, rounded to whole pixels.

    Raises:
        UserError: The region extends beyond the image.
    """
    if roi is None:
        return None
    height, width = image.shape[:2]
    x, y, columns, rows = (round(number) for number in roi)
    if not (0 <= x < x + columns <= width and 0 <= y < y + rows <= height):
        allowed = f"(x, y, width, height) within the {width}×{height} image, pixels"
        raise UserError(f"roi {tuple(roi)}", allowed, "move or shrink the region")
    return x, y, columns, rows
