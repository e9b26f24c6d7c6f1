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
from jaxtyping import Bool, Float
from numpy.random import Generator

from dopepp.core.validation import Checked, Share
from dopepp.data.sample import Instance, Sample, silhouette
from dopepp.drawing.pictures import Mask, RGBImage, Shape
from dopepp.virtual.backgrounds import Backgrounds

MIN_PATCH_PX: Final = 2  # A patch of one pixel is always a solid colour.
MIN_CONTRAST: Final = 3.0  # standard deviation of a colour channel of a crop, grey levels

MAX_DRAWS: Final = 8  # Largest number of crops to sample from an image.


class BackgroundCrops:
    """Sampler of rectangular crops of an image, without padding, that show no object.

    No crop contains a pixel of ``silhouettes``. :meth:`draw` tries ``max_draws`` random crops.
    """

    def __init__(
        self,
        image: RGBImage,
        silhouettes: Sequence[Mask],
        min_contrast: float = MIN_CONTRAST,
        max_draws: int = MAX_DRAWS,
    ) -> None:
        self.image, self.min_contrast, self.max_draws = image, min_contrast, max_draws
        occupied = np.zeros(image.shape[:2], bool)
        for mask in silhouettes:
            occupied |= mask
        self._integral = cv2.integral(occupied.astype(np.uint8))

    def draw(self, size: Shape, rng: Generator) -> RGBImage | None:
        """Return the first of ``max_draws`` random (height, width) crops with contrast, or None."""
        windows = np.flatnonzero(self._is_free(size).ravel())
        for _ in range(self.max_draws if len(windows) else 0):
            crop = self._crop(int(rng.choice(windows)), size)
            if has_contrast(crop, self.min_contrast):
                return crop
        return None

    def search(self, size: Shape, rng: Generator) -> RGBImage | None:
        """Return a random crop among all crops of (height, width) that have contrast.

        If there are none, return a random crop with at least two colours, or None.
        """
        free = self._is_free(size)
        if not free.any():
            return None
        sums, squares = self._moments
        num = size[0] * size[1]
        # num²·variance is an integer below 2⁵³, so a single colour gives exactly 0.
        spread = (num * _windows(squares, size) - _windows(sums, size) ** 2).max(axis=2)
        spread[~free] = 0
        for least in ((num * self.min_contrast) ** 2, 1.0):
            windows = np.flatnonzero(spread.ravel() >= least)
            if len(windows):
                return self._crop(int(rng.choice(windows)), size)
        return None

    def largest(self, size: Shape, rng: Generator) -> RGBImage | None:
        """Return a crop of (height, width), halved until :meth:`search` finds one, or None."""
        height, width = size
        while True:
            crop = self.draw((height, width), rng)
            if crop is None:
                crop = self.search((height, width), rng)
            if crop is not None or max(height, width) == MIN_PATCH_PX:
                return crop
            height, width = max(MIN_PATCH_PX, height // 2), max(MIN_PATCH_PX, width // 2)

    def _is_free(self, size: Shape) -> Bool[np.ndarray, "rows columns"]:
        """Return whether a window of ``size`` shows no object, for each top left corner."""
        return np.asarray(_windows(self._integral, size) == 0)

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


def has_contrast(crop: RGBImage, min_contrast: float) -> bool:
    """Return whether a channel's standard deviation is at least ``min_contrast`` grey levels."""
    return float(crop.reshape(-1, 3).std(axis=0).max()) >= min_contrast


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
        min_contrast: Contrast that a patch should have, see :func:`has_contrast`.
        max_draws: Number of random crops to try per patch size, and then in other images.
    """

    probability: Share = 0.5
    max_height: Share = 0.8
    max_width: Share = 0.8
    min_contrast: float = MIN_CONTRAST
    max_draws: int = MAX_DRAWS

    def __call__(self, sample: Sample, rng: Generator, other: Backgrounds) -> Sample:
        """Return a masked copy of an unpadded sample; ``other`` replaces a missing background."""
        silhouettes = [
            silhouette(instance, sample.image.shape[:2]) for instance in sample.instances
        ]
        crops = BackgroundCrops(sample.image, silhouettes, self.min_contrast, self.max_draws)
        image, covered = sample.image.copy(), np.zeros(sample.image.shape[:2], bool)
        for object_mask in silhouettes:
            if rng.random() >= self.probability or not object_mask.any():
                continue
            patch = self._patch(object_mask, rng)
            if patch is None:
                continue
            height, width = (side.stop - side.start for side in patch)
            crop = self._crop(crops, (height, width), rng, other)
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

    def _crop(
        self, crops: BackgroundCrops, size: Shape, rng: Generator, other: Backgrounds
    ) -> RGBImage | None:
        """Return a random crop of the image's background, at most (height, width) in size.

        If there is none, try ``max_draws`` crops from ``other``; None if none has enough contrast.
        """
        crop = crops.largest(size, rng)
        if crop is not None:
            return crop
        height, width = crops.image.shape[:2]
        for _ in range(self.max_draws):
            background = other.draw(rng, width, height)
            row = int(rng.integers(0, height - size[0] + 1))
            column = int(rng.integers(0, width - size[1] + 1))
            crop = background[row : row + size[0], column : column + size[1]]
            if has_contrast(crop, self.min_contrast):
                return crop
        return None


def _middle_slice(patch: slice, length: int) -> slice:
    start = patch.start + (patch.stop - patch.start - length) // 2
    return slice(start, start + length)
