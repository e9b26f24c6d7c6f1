"""Shade objects (paper Table 3): cover a given share of the visible pixels of each object.

Random crops of the image's background cover an object inside its box, one after another. Pixels
are ordered by the time of covering; a share is the beginning of this order, so it is exact to half
a pixel, and a larger share contains a smaller share. A patch covers only the object for which it
is sampled. Training uses :mod:`dopepp.data.transforms.masking` (Eq. 4, one patch) instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Int
from numpy.random import Generator

from dopepp.data.sample import Instance, Purpose, Sample, item_rng, silhouette
from dopepp.data.transforms.masking import (
    MIN_PATCH_PX,
    BackgroundCrops,
    cover_instances,
    mask_slices,
)
from dopepp.drawing.pictures import Mask, RGBImage

TOLERANCE: Final = 0.02  # allowed difference of the covered share from the requested share
_SIDES: Final = (0.15, 0.5)
"""Range of a patch's sides as shares of the sides of the object's box, so several patches fit."""

_MAX_PATCHES: Final = 300  # more would be tiny, as the background has no room for larger crops
_NEVER: Final = np.iinfo(np.int32).max


@dataclass(frozen=True)
class ShadedSample:
    """An image whose objects are partly covered by patches of background.

    Attributes:
        share: Share of each instance's visible pixels to cover, in [0, 1].
        sample: The image; depth is 0 (unknown) under patches.
        reached: Actual share; None for an instance without a mask or a visible pixel.
    """

    share: float
    sample: Sample
    reached: tuple[float | None, ...]


def shade(sample: Sample, shares: Sequence[float], seed: int, index: int) -> list[ShadedSample]:
    """Return one copy of an image per share, with this share of each object covered by patches.

    The patches are crops of the image's background. They depend on ``seed`` and on the image's
    ``index`` in the test set. ``shares`` refer to each instance's visible pixels.
    """
    shape = sample.image.shape[:2]
    silhouettes = [silhouette(instance, shape) for instance in sample.instances]
    crops = BackgroundCrops(sample.image, silhouettes)
    # Each instance has its own generator, so that no instance changes the patches of another.
    rngs = item_rng(seed, Purpose.SHADING, 0, index).spawn(len(silhouettes))
    largest = max(shares, default=0.0)
    covers = []
    for number, (instance, rng) in enumerate(zip(sample.instances, rngs, strict=True)):
        if _can_be_shaded(instance):
            visible, others = silhouettes[number], np.zeros(shape, bool)
            for other in silhouettes[:number] + silhouettes[number + 1 :]:
                others |= other
            covers.append(_Cover(visible, others & ~visible, crops, largest, rng))
    return [_cover_share(sample, silhouettes, covers, share) for share in shares]


def _can_be_shaded(instance: Instance) -> bool:
    return instance.mask is not None and bool(instance.mask.any())


def _cover_share(
    sample: Sample, silhouettes: Sequence[Mask], covers: Sequence[_Cover], share: float
) -> ShadedSample:
    """Return the sample with patches on a share of each object's visible pixels."""
    image, covered = sample.image.copy(), np.zeros(sample.image.shape[:2], bool)
    for cover in covers:
        is_patch = cover.pixels_of_share(share)
        image[cover.box][is_patch] = cover.pixels[is_patch]
        covered[cover.box] |= is_patch
    instances = cover_instances(sample.instances, silhouettes, covered)
    depth = None if sample.depth is None else np.where(covered, np.float32(0), sample.depth)
    reached = (
        after.masked_fraction if _can_be_shaded(before) else None
        for before, after in zip(sample.instances, instances, strict=True)
    )
    shaded = replace(sample, image=image, instances=instances, depth=depth)
    return ShadedSample(share, shaded, tuple(reached))


class _Cover:
    """Patches on ``share`` of an instance's ``visible`` pixels, in the bounding box of these.

    ``order`` numbers the pixels of the box in the order of covering, and ``pixels`` has the colours
    of the patches. No patch covers ``protected`` pixels.
    """

    def __init__(
        self, visible: Mask, protected: Mask, crops: BackgroundCrops, share: float, rng: Generator
    ) -> None:
        self.box = mask_slices(visible)
        self._visible, self._protected = visible[self.box], protected[self.box]
        shape = self._visible.shape
        self.pixels = np.zeros((*shape, 3), np.uint8)
        self.order: Int[np.ndarray, "rows columns"] = np.full(shape, _NEVER, np.int32)
        self._num_visible, self._num_covered = int(np.count_nonzero(self._visible)), 0
        for _ in range(_MAX_PATCHES):
            uncovered = np.argwhere(self._visible & (self.order == _NEVER))
            if self._num_visible - len(uncovered) >= round(share * self._num_visible):
                break
            crop = self._draw_crop(crops, rng)
            if crop is None:
                break
            self._add_patch(crop, uncovered[rng.integers(len(uncovered))], rng)

    def pixels_of_share(self, share: float) -> Bool[np.ndarray, "rows columns"]:
        """Return which pixels of the box are covered at a share of the visible pixels."""
        num_pixels = round(share * self._num_visible)
        if num_pixels == 0:
            return np.zeros(self.order.shape, bool)
        last = np.sort(self.order[self._visible])[num_pixels - 1]
        return self.order <= min(int(last), _NEVER - 1)

    def _draw_crop(self, crops: BackgroundCrops, rng: Generator) -> RGBImage | None:
        """Sample a crop of random size, halved until the background has one, or None."""
        extent = self._visible.shape
        if min(extent) < MIN_PATCH_PX:
            return None
        height, width = (
            max(MIN_PATCH_PX, int(rng.uniform(*_SIDES) * extent[axis])) for axis in (0, 1)
        )
        return crops.draw((height, width), rng)

    def _add_patch(self, crop: RGBImage, pixel: Int[np.ndarray, "2"], rng: Generator) -> None:
        """Insert a crop below earlier crops, at a random place over ``pixel`` (row, column)."""
        slices = []
        for position, length, extent in zip(pixel, crop.shape, self.order.shape, strict=False):
            first, last = max(0, position - length + 1), min(position, extent - length)
            start = int(rng.integers(first, last + 1))
            slices.append(slice(start, start + length))
        patch = slices[0], slices[1]
        new = (self.order[patch] == _NEVER) & ~self._protected[patch]
        num_new = int(np.count_nonzero(new))
        self.order[patch][new] = np.arange(self._num_covered, self._num_covered + num_new)
        self.pixels[patch][new] = crop[new]
        self._num_covered += num_new
