"""Sizes of an image in which the network runs, and detections in these sizes.

A network detects a part in a limited range of sizes. A part of diameter d at depth z is d·f/z
pixels long in an image of focal length f. In training, the length was ``smallest_px`` to
``largest_px``. The image is resized so that parts at the expected distances have lengths in this
range. If the distances vary more than in training, the network runs on the image in several sizes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import UInt8

from dopepp.core.validation import check
from dopepp.drawing.pictures import RGBImage, Size
from dopepp.geometry.camera import (
    CameraMatrix,
    Letterbox,
    crop_camera,
    focal_length,
    project_keypoints,
)
from dopepp.geometry.cuboid import Cuboid
from dopepp.inference.input_image import METRES, Distances, Region, check_region
from dopepp.parts.size import LearnedRange

if TYPE_CHECKING:
    from dopepp.models.checkpoint import Checkpoint
    from dopepp.recovery.detection import Detection

MAX_PIXELS: Final = 640 * 480  # largest resized image; limits the smallest detectable part
MARGIN: Final = 1.1  # ratio of two sizes of a part that hardly changes a network's detections


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
    """Return the size of training images; None if it would give no further detections.

    In this size, parts at other distances than the trained distances may have a trained size. None
    is returned if ``boxes`` include the size, or if even the nearest part is too small in it. The
    latter is usual for networks that were trained on small windows of large images.
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
