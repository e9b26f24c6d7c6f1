"""The picture a caller gives: checked, with its depth, and in the sizes in which a network sees it.

A network knows a part in a range of sizes only. A part of diameter d at depth z is d·f/z pixels
long in a picture of focal length f. The network has seen it from ``smallest_px`` to ``largest_px``
long, so a picture is resized until the parts that are looked for have such sizes; where their
distances vary more than the network's did, several times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from dopepp.core.errors import UserError
from dopepp.core.validation import Span, check
from dopepp.drawing.pictures import Picture, Size, read_image
from dopepp.geometry.camera import (
    ANYWHERE,
    WHOLE,
    CameraMatrix,
    Letterbox,
    check_camera,
    crop_camera,
    focal_length,
)
from dopepp.parts.size import Seen

if TYPE_CHECKING:
    from dopepp.models.checkpoint import Checkpoint
    from dopepp.recovery.detection import Detection

Region = tuple[int, int, int, int]  # x, y, width and height, pixels

Distances = tuple[float, float] | Literal["any"]
"""Nearest and farthest depth, metres; ``any``: wherever the network can see a part."""

Depth = Float[np.ndarray, "height width"]
Depth32 = Float32[np.ndarray, "height width"]  # metres along z of every pixel

Coefficients = Float[np.ndarray, "coefficients"]  # of a lens's distortion, in OpenCV's order

FARTHEST: Final = 50.0
"""Metres. No depth camera for parts sees so far; millimetres taken for metres do."""

MAX_PIXELS: Final = 640 * 480  # of a resized picture: a part too small for that is not looked for
MARGIN: Final = 1.1  # factor on a size that makes no difference to a network


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


def checked_depth(depth: Depth, image_size: tuple[int, int]) -> Depth32:
    """Return depth, metres along z, as float32, 0 where it is unknown (0, NaN or infinite).

    A :class:`UserError`: it is not aligned to a colour image of (width, height), is no array of
    floats, has negative values, or its median cannot be in metres.
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
    known = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    measured = known[known != 0]
    if measured.size and measured.min() < 0:
        got = f"depth with values down to {measured.min():.4g}"
        raise UserError(got, "metres along z, 0 where unknown", "check how the depth was decoded")
    if measured.size and np.median(measured) > FARTHEST:
        raise UserError(
            f"depth with a median of {np.median(measured):.4g} m",
            f"metres, a median of at most {FARTHEST:g}",
            "divide by 1000 if it is in millimetres (or by the camera's own depth scale)",
        )
    return known


def read_depth(path: Path, scale: float) -> Depth32:
    """Read a PNG of 16 bits as metres, 0 where unknown; ``scale`` is metres per unit.

    A :class:`UserError`: the scale is no positive number, or the file is no 16-bit image.
    """
    if not 0 < scale < np.inf:
        fix = "pass 0.001 for millimetres"
        raise UserError(f"depth scale {scale}", "metres per unit, above 0", fix)
    units = read_image(path)
    if units.dtype != np.uint16 or units.ndim != 2:
        raise UserError(
            f"depth image {path} of type {units.dtype} and shape {units.shape}",
            "a PNG with one channel of 16 bits",
            "save the raw depth, not a coloured picture of it",
        )
    return (units * scale).astype(np.float32)


def undistorted_depth(depth: Depth32, K: CameraMatrix, distortion: Coefficients) -> Depth32:
    """Undistort depth as the image is, with each pixel's nearest value: a mean is no surface."""
    size = depth.shape[::-1]
    maps = cv2.initUndistortRectifyMap(K, distortion, np.eye(3), K, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(depth, *maps, cv2.INTER_NEAREST), np.float32)


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


def letterboxes(
    checkpoint: Checkpoint, K: CameraMatrix, image: Picture, distances: Distances | None = None
) -> list[Letterbox]:
    """Return the sizes in which a network looks at an image, the smallest first.

    Without ``distances`` it looks where training had the parts, and at the whole image in the size
    of the training's, which shows parts that fill it; for the training's camera both are one. A
    checkpoint that does not know distances has the second look only. A :class:`UserError`: the
    distances are no range of metres.
    """
    size = image.shape[1], image.shape[0]
    learned = Letterbox.fit(size, checkpoint.input_size)
    scales: list[float] = []
    for part in checkpoint.parts:
        if part.name in checkpoint.seen:
            seen, reach = checkpoint.seen[part.name], part.diameter * focal_length(K)
            scales += _scales(seen, reach, _depths(seen, reach, size, distances))
    if not scales or distances is None:
        scales.append(learned.scale_x)
    boxes: list[Letterbox] = []
    for scale in sorted(scales):
        if boxes and scale < MARGIN * boxes[-1].scale_x:
            continue
        # The training's camera gets the training's size to the pixel.
        same = 1 / MARGIN < scale / learned.scale_x < MARGIN
        boxes.append(learned if same else Letterbox.scaled(size, scale))
    fitting = [one for one in boxes if one.width * one.height <= MAX_PIXELS]
    return fitting or [Letterbox.scaled(size, math.sqrt(MAX_PIXELS / (size[0] * size[1])))]


def merged(scales: Sequence[Sequence[Detection]]) -> list[Detection]:
    """Return the detections of all scales, the best one of each instance, best score first.

    Two of different scales are of one instance where their centres are nearer than half the larger
    one's extent.
    """
    ranked = [(one, number) for number, found in enumerate(scales) for one in found]
    ranked.sort(key=lambda pair: -pair[0].score)
    kept: list[tuple[Detection, int]] = []
    for one, number in ranked:
        others = (other for other, scale in kept if scale != number)
        if not any(_are_same(one, other) for other in others):
            kept.append((one, number))
    return [one for one, _ in kept]


def _depths(
    seen: Seen, reach: float, size: Size, distances: Distances | None
) -> tuple[float, float]:
    """Return the nearest and farthest depth to look at, metres.

    ``reach`` is how many pixels long the part is at one metre. Anywhere is from where it fills the
    picture to where it is as small as was learned, in the picture as it is or as MAX_PIXELS allow.
    """
    if distances is None:
        return seen.nearest, seen.farthest
    if distances == "any":
        scale = min(1.0, math.sqrt(MAX_PIXELS / (size[0] * size[1])))
        nearest = reach / min(size)
        return nearest, max(nearest, reach * scale / seen.smallest_px)
    check("distances", distances, tuple[float, float], Span(0.001, 1000.0, "metres"))
    return distances


def _scales(seen: Seen, reach: float, depths: tuple[float, float]) -> Sequence[float]:
    """Return the fewest factors on a picture's sides that show a part in sizes that were learned.

    At the middle depth of its range each shows the part in the middle size.
    """
    near, far = depths
    learned = math.log(MARGIN**2 * seen.largest_px / seen.smallest_px)
    count = max(1, math.ceil(math.log(far / near) / learned))
    middles = near * (far / near) ** ((np.arange(count) + 0.5) / count)
    scales: list[float] = (math.sqrt(seen.smallest_px * seen.largest_px) * middles / reach).tolist()
    return scales


def _are_same(one: Detection, other: Detection) -> bool:
    apart = np.linalg.norm(one.keypoints[-1] - other.keypoints[-1])
    extent = max(np.ptp(each.keypoints[:-1], axis=0).max() for each in (one, other))
    return one.object == other.object and bool(apart < extent / 2)
