"""Depth as a user gives it: metres along z, aligned to the colour image, 0 or NaN where unknown."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32

from dopepp.drawing.pictures import read_image
from dopepp.errors import UserError

FARTHEST: Final = 50.0
"""Metres. No depth camera for parts sees so far; millimetres taken for metres do."""


def checked_depth(
    depth: Float[np.ndarray, "height width"], image_size: tuple[int, int]
) -> Float32[np.ndarray, "height width"]:
    """Return depth as float32, 0 where unknown.

    Args:
        depth: Metres along z; 0, NaN or infinite where unknown.
        image_size: (width, height) of the colour image it is aligned to.

    Raises:
        UserError: It has another shape, is no array of floats, has negative values, or its median
            cannot be in metres.
    """
    depth = np.asarray(depth)
    if depth.shape != image_size[::-1]:
        raise UserError(
            f"depth of shape {depth.shape} for an image of {image_size[0]}×{image_size[1]}",
            f"one value per pixel, shape {image_size[::-1]}",
            "align the depth to the colour image first",
        )
    if not np.issubdtype(depth.dtype, np.floating):
        raise UserError(
            f"depth of type {depth.dtype}",
            "floats in metres",
            "convert it, e.g. depth.astype('float32') / 1000 for millimetres",
        )
    known = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    measured = known[known != 0]
    if measured.size and measured.min() < 0:
        raise UserError(
            f"depth with values down to {measured.min():.4g}",
            "metres along z, 0 where unknown",
            "check how the depth was decoded",
        )
    if measured.size and np.median(measured) > FARTHEST:
        raise UserError(
            f"depth with a median of {np.median(measured):.4g} m",
            f"metres, a median of at most {FARTHEST:g}",
            "divide by 1000 if it is in millimetres (or by the camera's own depth scale)",
        )
    return known


def read_depth(path: Path, scale: float) -> Float32[np.ndarray, "height width"]:
    """Read a 16-bit depth image as metres, 0 where unknown.

    Args:
        path: A PNG file.
        scale: Metres per unit.

    Raises:
        UserError: The scale is no positive number, or the file is no 16-bit image.
    """
    if not 0 < scale < np.inf:
        raise UserError(
            f"depth scale {scale}", "metres per unit, above 0", "pass 0.001 for millimetres"
        )
    units = read_image(path)
    if units.dtype != np.uint16 or units.ndim != 2:
        raise UserError(
            f"depth image {path} of type {units.dtype} and shape {units.shape}",
            "a PNG with one channel of 16 bits",
            "save the raw depth, not a coloured picture of it",
        )
    return (units * scale).astype(np.float32)


def undistorted_depth(
    depth: Float32[np.ndarray, "height width"],
    K: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "coefficients"],
) -> Float32[np.ndarray, "height width"]:
    """Undistort depth as the image is, with each pixel's nearest value: a mean is no surface."""
    size = depth.shape[::-1]
    maps = cv2.initUndistortRectifyMap(K, distortion, np.eye(3), K, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(depth, *maps, cv2.INTER_NEAREST), np.float32)
