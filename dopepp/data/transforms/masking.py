"""Random mask local processing (paper Eq. 3, 4): cover a part of the object with background.

A patch is a crop of the image's background, never a solid colour, and at most 0.8 of the object's
box high and wide; it is smaller if the background has no window of this size. Masks and visible
fractions lose the covered pixels; keypoints stay, because the network must still estimate them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from dopepp.core.validation import Checked, Share
from dopepp.data.sample import Instance, Sample, silhouette
from dopepp.drawing.pictures import Mask, RGBImage, Shape
from dopepp.virtual.backgrounds import Backgrounds

MIN_PATCH_PX: Final = 2  # a patch of one pixel is always a solid colour
MIN_CONTRAST: Final = 3.0  # standard deviation of a colour channel of a crop, grey levels
MAX_DRAWS: Final = 8  # random crops per patch size, and then in other images


class BackgroundCrops:
    """Sampler of rectangular crops, without a pixel of ``silhouettes``, of an unpadded image."""

    def __init__(self, image: RGBImage, silhouettes: Sequence[Mask]) -> None:
        self.image = image
        occupied = np.any([np.zeros(image.shape[:2], bool), *silhouettes], axis=0)
        self._integral = cv2.integral(occupied.astype(np.uint8))

    def draw(self, size: Shape, rng: Generator) -> RGBImage | None:
        """Return a crop of (height, width), halved until a crop has several colours, or None."""
        height, width = size
        while True:
            crop = self._draw((height, width), rng)
            if crop is not None or max(height, width) == MIN_PATCH_PX:
                return crop
            height, width = max(MIN_PATCH_PX, height // 2), max(MIN_PATCH_PX, width // 2)

    def _draw(self, size: Shape, rng: Generator) -> RGBImage | None:
        """Return the first of a few random crops with contrast, or else any such crop.

        If no crop has contrast, return a random crop with at least two colours, or None.
        """
        free = _windows(self._integral, size) == 0
        windows = np.flatnonzero(free.ravel())
        for _ in range(MAX_DRAWS if len(windows) else 0):
            crop = self._crop(int(rng.choice(windows)), size)
            if has_contrast(crop):
                return crop
        sums, squares = self._moments
        num = size[0] * size[1]
        # num²·variance is an integer below 2⁵³, so a single colour gives exactly 0.
        spread = (num * _windows(squares, size) - _windows(sums, size) ** 2).max(axis=2, initial=0)
        spread[~free] = 0
        for least in ((num * MIN_CONTRAST) ** 2, 1.0):
            windows = np.flatnonzero(spread.ravel() >= least)
            if len(windows):
                return self._crop(int(rng.choice(windows)), size)
        return None

    @cached_property
    def _moments(self) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Integral images of the pixels and of their squares."""
        sums, squares = cv2.integral2(self.image, sdepth=cv2.CV_64F, sqdepth=cv2.CV_64F)
        return sums, squares

    def _crop(self, window: int, size: Shape) -> RGBImage:
        """Return the window with this number, counting top left corners row by row."""
        row, column = divmod(window, self.image.shape[1] - size[1] + 1)
        return self.image[row : row + size[0], column : column + size[1]]


def _windows(integral: np.ndarray, size: Shape) -> np.ndarray:
    height, width = size
    return np.asarray(
        integral[height:, width:]
        - integral[:-height, width:]
        - integral[height:, :-width]
        + integral[:-height, :-width]
    )


def has_contrast(crop: RGBImage) -> bool:
    """Return whether a channel's standard deviation is at least ``MIN_CONTRAST``."""
    return float(crop.reshape(-1, 3).std(axis=0).max()) >= MIN_CONTRAST


def mask_slices(mask: Mask) -> tuple[slice, slice]:
    """Return the row slice and column slice of the bounding box of a mask that is not empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def cover_instances(
    instances: Sequence[Instance], silhouettes: Sequence[Mask], covered: Mask
) -> list[Instance]:
    """Remove covered pixels from masks and visible fractions; keypoints and poses stay.

    The covered share of an instance's silhouette becomes its ``masked_fraction``.
    """
    remaining = []
    for instance, visible in zip(instances, silhouettes, strict=True):
        num_visible = int(np.count_nonzero(visible))
        if num_visible:
            share = int(np.count_nonzero(visible & covered)) / num_visible
            mask = None if instance.mask is None else instance.mask & ~covered
            fraction = instance.visible_fraction * (1 - share)
            instance = replace(
                instance, mask=mask, visible_fraction=fraction, masked_fraction=share
            )
        remaining.append(instance)
    return remaining


@dataclass(frozen=True)
class RandomMask(Checked):
    """Random background patch on each instance.

    Attributes:
        probability: Probability that an instance gets a patch.
        max_height: Largest patch height as a share of the object's box height (paper: 0.8).
        max_width: Largest patch width as a share of the object's box width (paper: 0.8).
    """

    probability: Share = 0.5
    max_height: Share = 0.8
    max_width: Share = 0.8

    def __call__(self, sample: Sample, rng: Generator, other: Backgrounds) -> Sample:
        """Return a masked copy of an unpadded sample; ``other`` replaces a missing background."""
        shape = sample.image.shape[:2]
        silhouettes = [silhouette(instance, shape) for instance in sample.instances]
        crops = BackgroundCrops(sample.image, silhouettes)
        image, covered = sample.image.copy(), np.zeros(shape, bool)
        for object_mask in silhouettes:
            if rng.random() >= self.probability or not object_mask.any():
                continue
            patch = self._patch(object_mask, rng)
            if patch is None:
                continue
            size = patch[0].stop - patch[0].start, patch[1].stop - patch[1].start
            crop = crops.draw(size, rng)
            if crop is None:
                crop = _crop_of(other, shape, size, rng)
            if crop is not None:
                rows, columns = map(_middle_slice, patch, crop.shape)
                image[rows, columns], covered[rows, columns] = crop, True
        instances = cover_instances(sample.instances, silhouettes, covered)
        return replace(sample, image=image, instances=instances)

    def _patch(self, object_mask: Mask, rng: Generator) -> tuple[slice, slice] | None:
        """Sample a patch's rows and columns in the mask's box; None if the box is too small."""
        slices = []
        limits = self.max_height, self.max_width
        for side, limit in zip(mask_slices(object_mask), limits, strict=True):
            extent = side.stop - side.start
            longest = int(limit * extent)
            if longest < MIN_PATCH_PX:
                return None
            length = int(rng.integers(MIN_PATCH_PX, longest + 1))
            offset = side.start + int(rng.integers(0, extent - length + 1))
            slices.append(slice(offset, offset + length))
        return slices[0], slices[1]


def _crop_of(other: Backgrounds, shape: Shape, size: Shape, rng: Generator) -> RGBImage | None:
    """Return a crop with contrast of one of a few other images, of ``shape``, or None."""
    (height, width), (rows, columns) = shape, size
    for _ in range(MAX_DRAWS):
        background = other.draw(rng, width, height)
        row = int(rng.integers(0, height - rows + 1))
        column = int(rng.integers(0, width - columns + 1))
        crop = background[row : row + rows, column : column + columns]
        if has_contrast(crop):
            return crop
    return None


def _middle_slice(patch: slice, length: int) -> slice:
    start = patch.start + (patch.stop - patch.start - length) // 2
    return slice(start, start + length)
