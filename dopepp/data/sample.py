"""Define the sample that every source returns: an image, its camera and its posed objects.

To add a source, write a class with the :class:`DescribedSource` methods and one YAML file in
``conf/data``. Its random draws come from :func:`item_rng`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, Protocol

import cv2
import numpy as np
from jaxtyping import Float
from numpy.random import Generator
from numpy.typing import NDArray

from dopepp.drawing.pictures import DepthMap, Mask, RGBImage, Shape, Size
from dopepp.geometry.camera import CameraMatrix, Letterbox, Transform, crop_camera


@dataclass
class Instance:
    """An annotated object on an image.

    Attributes:
        label: Name of the object's part.
        T_cam_obj: Rigid transform from object to camera frame, (4, 4), metres, float64.
        keypoints: Projected cuboid corners, then its centroid, pixels; NaN behind the camera.
        visible_fraction: Visible share of the object's full silhouette, occlusion and truncation
            both counted, in [0, 1].
        mask: Visible pixels, or None if the source has no mask.
        wanted: Whether the test set lists the object as a target to find; None without a list.
        masked_fraction: Share of the visible pixels that artificial patches have covered; these
            pixels no longer count in ``visible_fraction`` and ``mask``.
    """

    label: str
    T_cam_obj: Transform
    keypoints: Float[np.ndarray, "9 2"]
    visible_fraction: float = 1.0
    mask: Mask | None = None
    masked_fraction: float = 0.0
    wanted: bool | None = None


@dataclass
class Sample:
    """An image and its ground truth.

    Attributes:
        K: Camera matrix in pixels of this image, float64.
        depth: Metres along the camera's z axis, float32, 0 if unknown; None without depth.
        source: Name of the source, e.g. ``ycb_video/data``.
        key: Name of the image within its source, e.g. ``0050/000003``.
        T_world_cam: Rigid transform from camera to world frame, (4, 4), metres; None if unknown.
        others: Further images of the same static scene, each with ``T_world_cam``.
    """

    image: RGBImage
    K: CameraMatrix
    instances: list[Instance] = field(default_factory=list)
    depth: DepthMap | None = None
    source: str = ""
    key: str = ""
    T_world_cam: Transform | None = None
    others: Sequence[Sample] = ()

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image, pixels."""
        return self.image.shape[1], self.image.shape[0]


class SampleSource(Protocol):
    """A data set with random access; a sample depends only on (the source's seed, epoch, index)."""

    name: str

    def __len__(self) -> int:
        """Return the number of samples per epoch."""

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return sample ``index`` (from 0) of ``epoch``."""


@dataclass(frozen=True)
class SourceInfo:
    """Content of a source, for the log at the start of training and the fingerprint of the data.

    Attributes:
        identity: Settings and content hashes that determine the samples, in JSON types.
        num_instances: Number of instances by object name; empty if counting is slow.
        num_per_epoch: Number of images that a mix takes per epoch (default: all).
    """

    name: str
    num_images: int
    identity: Mapping[str, object] = field(default_factory=dict)
    num_instances: Mapping[str, int] = field(default_factory=dict)
    num_per_epoch: int | None = None


class DescribedSource(SampleSource, Protocol):
    """A sample source that also describes its content, as the DataModule requires."""

    def describe(self) -> list[SourceInfo]:
        """Return one entry, or an entry for each combined source of a mix."""

    def contains(self, label: str) -> bool:
        """Return whether a sample of any epoch can show the object named ``label``."""


class WrappedSource:
    """Base class of sources that modify the samples of another source.

    Args:
        source: Source of the unmodified samples.
        **identity: Settings of the modification, added to ``SourceInfo.identity``.
    """

    def __init__(self, source: DescribedSource, **identity: object) -> None:
        self._source, self.name, self._identity = source, source.name, identity

    def __len__(self) -> int:
        return len(self._source)

    def contains(self, label: str) -> bool:
        """Return whether the unmodified source contains the object."""
        return self._source.contains(label)

    def describe(self) -> list[SourceInfo]:
        """Describe the unmodified source, and add the settings of the modification."""
        return [
            replace(info, identity={**info.identity, **self._identity})
            for info in self._source.describe()
        ]


def silhouette(instance: Instance, shape: Shape) -> Mask:
    """Return the instance's mask or, without a mask, the filled hull of its projected cuboid.

    The hull contains the object's outline, so a crop that avoids the hull does not show the object.
    The hull is empty if the cuboid is partly behind the camera.
    """
    if instance.mask is not None:
        return instance.mask
    canvas = np.zeros(shape, np.uint8)
    if np.isfinite(instance.keypoints).all():
        # OpenCV clips to 16-bit coordinates; no useful image reaches that far.
        corners = np.clip(np.rint(instance.keypoints[:8]), -30_000, 30_000).astype(np.int32)
        cv2.fillConvexPoly(canvas, cv2.convexHull(corners), 1)
    return canvas.astype(bool)


def hull_areas(
    points_px: Float[np.ndarray, "points 2"], shape: tuple[int, ...]
) -> tuple[float, float]:
    """Return the area (px²) of the points' convex hull inside an image of ``shape``, and in total.

    Points behind the camera (NaN) are ignored. Fewer than three points have no area.
    """
    points = points_px[np.isfinite(points_px).all(axis=1)].astype(np.float32)
    if len(points) < 3:
        return 0.0, 0.0
    hull = cv2.convexHull(points)
    height, width = shape[:2]
    # Pixel 0 is a pixel's centre, so the image spans −½ … size − ½.
    corners = [[0, 0], [width, 0], [width, height], [0, height]]
    inside, _ = cv2.intersectConvexConvex(hull, np.array(corners, np.float32) - 0.5)
    return float(inside), float(cv2.contourArea(hull))


def reduce_visibility(
    before: Instance, after: Instance, shapes: tuple[Shape, Shape], scale: float = 1.0
) -> Instance:
    """Return ``after`` with the visible fraction that a crop or warp of the image leaves.

    The fraction is multiplied by the share of the mask's pixels (without a mask, of the area of the
    cuboid's hull) that the new image still shows.

    Args:
        before: The object on the original image.
        after: The object with keypoints and mask of the new image.
        shapes: (height, width) of the original image and of the new image, pixels.
        scale: Length in the new image, pixels, of a pixel of the original image.
    """
    area_before, area_after = (
        hull_areas(view.keypoints, shape)[0] if view.mask is None else float(view.mask.sum())
        for view, shape in zip((before, after), shapes, strict=True)
    )
    share = min(area_after / (scale**2 * area_before), 1.0) if area_before else 0.0
    return replace(after, visible_fraction=before.visible_fraction * share)


class Purpose(IntEnum):
    """Purpose of a random generator; the numbers enter the seed, so they must not change."""

    SHUFFLE = 101
    MIX = 102
    CYCLE = 103
    AUGMENT = 104
    BACKGROUND = 105
    SHADING = 106
    WINDOW = 107


def item_rng(seed: int, purpose: Purpose, epoch: int, index: int = 0) -> Generator:
    """Return a random generator that depends only on the four arguments, not on worker or rank."""
    # The purpose comes last, because a generator ignores trailing zeros: the factory draws its
    # scenes from [seed, epoch, index], which equals [seed, epoch, index, 0].
    return np.random.default_rng([seed, epoch, index, int(purpose)])


def resize_nearest(image: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """Resize by nearest neighbour: target pixel j takes source pixel ⌊(j + ½) / scale⌋.

    Integer arithmetic is exact; ``cv2.INTER_NEAREST`` takes ⌊j / scale⌋, half a pixel off.
    """
    rows = (2 * np.arange(height) + 1) * image.shape[0] // (2 * height)
    columns = (2 * np.arange(width) + 1) * image.shape[1] // (2 * width)
    return np.asarray(image[rows[:, None], columns])


def _map_pixels(sample: Sample, function: Callable[[NDArray[Any]], NDArray[Any]]) -> Sample:
    """Return a copy of a sample with a function applied to its depth image and masks."""

    def mapped(pixels: NDArray[Any] | None) -> NDArray[Any] | None:
        return None if pixels is None else function(pixels)

    instances = [replace(instance, mask=mapped(instance.mask)) for instance in sample.instances]
    return replace(sample, depth=mapped(sample.depth), instances=instances)


def resize_sample(sample: Sample, input_size: Size) -> Sample:
    """Resize a sample to fit into ``input_size`` at its aspect ratio, without padding."""
    box = Letterbox.fit(sample.size, input_size)
    if (box.width, box.height) == sample.size:
        return sample
    image, K = box.image(sample.image), box.camera(sample.K)
    sample = _map_pixels(sample, lambda pixels: resize_nearest(pixels, box.width, box.height))
    instances = [
        replace(instance, keypoints=box.points(instance.keypoints)) for instance in sample.instances
    ]
    return replace(sample, image=image, K=K, instances=instances)


def pad_sample(sample: Sample, input_size: Size) -> Sample:
    """Pad a sample to ``input_size`` with zeros at the right and bottom; K and keypoints stay."""
    width, height = sample.size
    if (width, height) == tuple(input_size):
        return sample

    def pad(array: NDArray[Any]) -> NDArray[Any]:
        padding = [(0, input_size[1] - height), (0, input_size[0] - width)]
        return np.pad(array, padding + [(0, 0)] * (array.ndim - 2))

    return replace(_map_pixels(sample, pad), image=pad(sample.image))


def crop_sample(sample: Sample, left: int, top: int, size: Size) -> Sample:
    """Crop a sample to ``size`` pixels at (left, top), with matching K, keypoints and fractions."""
    width, height = size

    def cut(pixels: NDArray[Any]) -> NDArray[Any]:
        return pixels[top : top + height, left : left + width]

    cropped, shapes = _map_pixels(sample, cut), (sample.image.shape[:2], (height, width))
    instances = [
        reduce_visibility(before, replace(after, keypoints=before.keypoints - (left, top)), shapes)
        for before, after in zip(sample.instances, cropped.instances, strict=True)
    ]
    K = crop_camera(sample.K, left, top)
    return replace(cropped, image=cut(sample.image), K=K, instances=instances)


def letterbox_sample(sample: Sample, input_size: Size) -> Sample:
    """Resize and pad a sample to exactly ``input_size`` (width, height)."""
    return pad_sample(resize_sample(sample, input_size), input_size)
