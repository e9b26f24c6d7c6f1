"""From a caller's image to the network's input: checks, lens distortion, and image sizes.

A network detects a part in a limited range of sizes. A part of diameter d at depth z is d·f/z
pixels long in an image of focal length f; in training, from ``smallest_px`` to ``largest_px``. The
image is resized so that parts at the expected distances have sizes in this range. If the distances
vary more than in training, the network runs on the image in several sizes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from dopepp.core.errors import UserError
from dopepp.core.validation import Span, check
from dopepp.drawing.pictures import RGBImage, Size, read_image
from dopepp.geometry.camera import (
    ANYWHERE,
    WHOLE,
    CameraMatrix,
    Letterbox,
    check_camera,
    crop_camera,
    focal_length,
    project_keypoints,
)
from dopepp.geometry.cuboid import Cuboid
from dopepp.parts.size import LearnedRange

if TYPE_CHECKING:
    from dopepp.models.checkpoint import Checkpoint
    from dopepp.recovery.detection import Detection

Region = tuple[int, int, int, int]  # x, y, width and height, pixels

Distances = tuple[float, float] | Literal["any"]
"""Nearest and farthest depth, metres; ``any``: all depths at which the network detects parts."""

Depth = Float[np.ndarray, "height width"]
Depth32 = Float32[np.ndarray, "height width"]  # metres along z of every pixel

Coefficients = Float[np.ndarray, "coefficients"]  # lens distortion, in OpenCV's order

FARTHEST: Final = 50.0
"""Median above which a depth image is rejected, metres: its values are probably millimetres."""

METRES: Final = Span(0.001, 1000.0, "metres")  # valid distances

MAX_PIXELS: Final = 640 * 480  # largest resized image; limits the smallest detectable part
MARGIN: Final = 1.1  # ratio of two sizes of a part that hardly changes a network's detections


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


@dataclass(frozen=True, eq=False)
class NetworkView:
    """Region of an image in one of the sizes that the network is run on."""

    region: RGBImage  # pixels of the image
    box: Letterbox  # resizing of the region
    K: CameraMatrix  # camera matrix of ``pixels``
    corner: tuple[int, int]  # x and y of the region in the image, pixels
    multiple: int  # the sides are padded to multiples of this number
    is_further: bool = False  # for parts that the other views do not show at a trained size

    @cached_property
    def pixels(self) -> UInt8[np.ndarray, "rows columns 3"]:
        """Resized region, padded at the right and bottom; computed on first use."""
        return resize_and_pad(self.region, self.box, self.multiple)

    def to_image(self, detection: Detection, cuboid: Cuboid, K: CameraMatrix) -> Detection:
        """Express a detection in pixels of the whole image, whose camera matrix is K."""
        other = detection.alternative
        return replace(
            detection,
            keypoints=project_keypoints(cuboid, detection.T_cam_obj, K),
            peaks=self.box.original_points(detection.peaks) + np.array(self.corner),
            reprojection_error_px=detection.reprojection_error_px / self.box.scale_x,
            alternative=None if other is None else self.to_image(other, cuboid, K),
        )

    def depths(self, seen: LearnedRange, diameter: float) -> tuple[float, float]:
        """Return the nearest and farthest depth at which a part is as large as in training, metres.

        Args:
            seen: Sizes of the part in training.
            diameter: Diameter of the part, metres.
        """
        reach = diameter * focal_length(self.K)
        return reach / (MARGIN * seen.largest_px), MARGIN * reach / seen.smallest_px


def network_views(
    checkpoint: Checkpoint,
    multiple: int,
    image: RGBImage,
    K: CameraMatrix,
    distances: Distances | None = None,
    roi: Region | None = None,
) -> list[NetworkView]:
    """Scale and pad an image to the inputs on which the network runs.

    Views of the expected distances come first, the smallest first. By default, a further view has
    the size of training images, unless it shows no trained part at a trained size.

    Args:
        checkpoint: Checkpoint of the network.
        multiple: The sides of the inputs are padded to multiples of this number.
        image: RGB, without distortion.
        K: Camera matrix, pixels.
        distances: Nearest and farthest expected depth of the parts, metres (default: the training
            range).
        roi: Region to process (default: the whole image).

    Raises:
        UserError: The region extends beyond the image, or the distances are not a range of metres.
    """
    x, y = 0, 0
    region = check_region(roi, image)
    if region is not None:
        x, y, columns, rows = region
        image = image[y : y + rows, x : x + columns]
        K = crop_camera(K, x, y)
    boxes = letterboxes(checkpoint, image, K, distances)
    views = [NetworkView(image, box, box.camera(K), (x, y), multiple) for box in boxes]
    further = _further_letterbox(checkpoint, image, K, boxes) if distances is None else None
    if further is not None:
        views.append(NetworkView(image, further, further.camera(K), (x, y), multiple, True))
    return views


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


def resize_and_pad(
    image: RGBImage, letterbox: Letterbox, multiple: int
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Resize an image, and pad it at the right and bottom to sides in multiples of ``multiple``."""
    width, height = letterbox.width, letterbox.height
    padded = np.zeros((height + -height % multiple, width + -width % multiple, 3), np.uint8)
    padded[:height, :width] = letterbox.image(image)
    return padded


def letterboxes(
    checkpoint: Checkpoint,
    image: RGBImage,
    K: CameraMatrix,
    distances: Distances | None = None,
) -> list[Letterbox]:
    """Return the sizes of an image on which the network runs, the smallest first.

    The sizes show the parts at the expected distances as large as in training. For a checkpoint
    that records no training distances, only the size of training images is used. See
    :func:`network_views` for the arguments.
    """
    size = image.shape[1], image.shape[0]
    learned = Letterbox.fit(size, checkpoint.input_size)
    scales: list[float] = []
    for part in checkpoint.parts:
        if part.name in checkpoint.seen:
            seen, reach = checkpoint.seen[part.name], part.diameter * focal_length(K)
            scales += _scales(seen, reach, _depths(seen, reach, size, distances))
    if not scales:
        scales.append(learned.scale_x)
    boxes: list[Letterbox] = []
    for scale in sorted(scales):
        if boxes and scale < MARGIN * boxes[-1].scale_x:
            continue
        # For the training camera, use exactly the size of training images.
        is_trained_size = 1 / MARGIN < scale / learned.scale_x < MARGIN
        boxes.append(learned if is_trained_size else Letterbox.scaled(size, scale))
    fitting = [box for box in boxes if box.width * box.height <= MAX_PIXELS]
    return fitting or [Letterbox.scaled(size, math.sqrt(MAX_PIXELS / (size[0] * size[1])))]


def _further_letterbox(
    checkpoint: Checkpoint, image: RGBImage, K: CameraMatrix, boxes: Sequence[Letterbox]
) -> Letterbox | None:
    """Return the size of training images; None if it shows nothing that ``boxes`` do not show.

    With a longer focal length than in training, it shows farther parts at a trained size, and with
    a shorter focal length or a wider image nearer parts. The windows that a network was trained on
    are often much smaller than the image. At their size, even the nearest part is too small.
    """
    learned = Letterbox.fit((image.shape[1], image.shape[0]), checkpoint.input_size)
    is_shown = any(1 / MARGIN < box.scale_x / learned.scale_x < MARGIN for box in boxes)
    if is_shown or learned.width * learned.height > MAX_PIXELS:
        return None
    reach = learned.scale_x * focal_length(K)
    for part in checkpoint.parts:
        seen = checkpoint.seen.get(part.name)
        if seen is None or reach * part.diameter / seen.nearest >= seen.smallest_px:
            return learned
    return None


def merge_scales(scales: Sequence[Sequence[Detection]]) -> list[Detection]:
    """Merge the detections of all image sizes, and keep the best of each instance, best first.

    Detections from different image sizes belong to one instance if :func:`are_same`.

    Args:
        scales: Detections of each image size, in pixels of the whole image.
    """
    ranked = [(detection, scale) for scale, group in enumerate(scales) for detection in group]
    ranked.sort(key=lambda pair: -pair[0].score)
    kept: list[tuple[Detection, int]] = []
    for detection, scale in ranked:
        others = (other for other, other_scale in kept if other_scale != scale)
        if not any(are_same(detection, other) for other in others):
            kept.append((detection, scale))
    return [detection for detection, _ in kept]


def _depths(
    seen: LearnedRange, reach: float, size: Size, distances: Distances | None
) -> tuple[float, float]:
    """Return the nearest and farthest depth at which the part is searched, metres.

    ``reach`` is the part's length on the image at a depth of one metre, pixels. By default, the
    depths are those of training. For ``any``, the part fills the image at the nearest depth. At the
    farthest depth it is as small as in training, after the image is reduced to MAX_PIXELS.
    """
    if distances is None:
        return seen.nearest, seen.farthest
    if distances == "any":
        scale = min(1.0, math.sqrt(MAX_PIXELS / (size[0] * size[1])))
        nearest = reach / min(size)
        return nearest, max(nearest, reach * scale / seen.smallest_px)
    check("distances", distances, tuple[float, float], METRES)
    return distances


def _scales(seen: LearnedRange, reach: float, depths: tuple[float, float]) -> Sequence[float]:
    """Return the smallest set of scales at which a part has a size seen in training at all depths.

    Each scale covers an equal ratio of depths. At the geometric mean of these depths, the part has
    the geometric mean of the sizes seen in training.

    Args:
        seen: Sizes of the part in training.
        reach: Length of the part on the image at a depth of one metre, pixels.
        depths: Nearest and farthest depth, metres.
    """
    near, far = depths
    learned = math.log(MARGIN**2 * seen.largest_px / seen.smallest_px)
    count = max(1, math.ceil(math.log(far / near) / learned))
    middles = near * (far / near) ** ((np.arange(count) + 0.5) / count)
    scales: list[float] = (math.sqrt(seen.smallest_px * seen.largest_px) * middles / reach).tolist()
    return scales


def are_same(first: Detection, second: Detection) -> bool:
    """Return whether two detections on one image show the same instance.

    The names must agree, and the projected centroids must be closer than half the extent of the
    larger cuboid, pixels.
    """
    distance = np.linalg.norm(first.keypoints[-1] - second.keypoints[-1])
    extents = [np.ptp(detection.keypoints[:-1], axis=0).max() for detection in (first, second)]
    return first.object == second.object and bool(distance < max(extents) / 2)
