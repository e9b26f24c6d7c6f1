"""Random mask local processing (paper Eq. 3, 4): cover a part of the object with background.

A patch is a crop of the image's own background, never a solid colour, at most 0.8 of the object's
box high and wide; it is smaller where the background has no such window. The network still has to
place the keypoints that the patch covers: keypoints stay as they are, while masks and visible
fractions lose the covered pixels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, UInt8

from dopepp.data.covering import (
    MAX_DRAWS,
    MIN_CONTRAST,
    MIN_PATCH_PX,
    BackgroundCrops,
    covered_instance,
    has_contrast,
)
from dopepp.data.sample import Sample
from dopepp.data.silhouette import silhouette
from dopepp.virtual.backgrounds import Backgrounds


class RandomMask:
    """Cover each instance with one background patch, with a probability.

    Args:
        probability: Chance of each instance to get a patch.
        max_height: Largest patch height as a share of the object's box height (paper: 0.8).
        max_width: Largest patch width as a share of the object's box width (paper: 0.8).
        min_contrast: A crop counts as solid when no colour channel's standard deviation reaches
            this many grey levels.
        max_draws: Crops drawn from each picture until one is not solid; an instance for which even
            the other picture gives none stays uncovered, with ``masked_fraction`` 0.

    Raises:
        ValueError: A share or the probability is outside [0, 1].
    """

    def __init__(
        self,
        probability: float = 0.5,
        max_height: float = 0.8,
        max_width: float = 0.8,
        min_contrast: float = MIN_CONTRAST,
        max_draws: int = MAX_DRAWS,
    ) -> None:
        if not all(0.0 <= share <= 1.0 for share in (probability, max_height, max_width)):
            raise ValueError(
                f"probability={probability}, max_height={max_height}, max_width={max_width}: "
                "each must be in [0, 1]"
            )
        self.probability, self.max_height, self.max_width = probability, max_height, max_width
        self.min_contrast, self.max_draws = min_contrast, max_draws

    def __call__(self, sample: Sample, rng: np.random.Generator, other: Backgrounds) -> Sample:
        """Return a masked copy of the sample; the argument is not changed.

        Args:
            sample: Image with instances, unpadded, so that padding is never taken as background.
            rng: The item's generator.
            other: Gives another picture when the image has no fitting background left.
        """
        silhouettes = [
            silhouette(instance, sample.image.shape[:2]) for instance in sample.instances
        ]
        crops = BackgroundCrops(sample.image, silhouettes, self.min_contrast, self.max_draws)
        image, covered = sample.image.copy(), np.zeros(sample.image.shape[:2], bool)
        for seen in silhouettes:
            if rng.random() >= self.probability or not seen.any():
                continue
            patch = self._patch(seen, rng)
            if patch is None:
                continue
            crop = self._crop(crops, (_length(patch[0]), _length(patch[1])), rng, other)
            if crop is not None:
                rows, columns = map(_middle, patch, crop.shape)
                image[rows, columns], covered[rows, columns] = crop, True
        instances = [
            covered_instance(instance, seen, covered)
            for instance, seen in zip(sample.instances, silhouettes, strict=True)
        ]
        return replace(sample, image=image, instances=instances)

    def _patch(
        self, seen: Bool[np.ndarray, "height width"], rng: np.random.Generator
    ) -> tuple[slice, slice] | None:
        """Draw a patch inside the object's box; None when the box is too small for any."""
        slices = []
        for axis, limit in ((1, self.max_height), (0, self.max_width)):
            hit = np.flatnonzero(seen.any(axis=axis))
            start, extent = int(hit[0]), int(hit[-1] - hit[0] + 1)
            longest = int(limit * extent)
            if longest < MIN_PATCH_PX:
                return None
            length = int(rng.integers(MIN_PATCH_PX, longest + 1))
            offset = start + int(rng.integers(0, extent - length + 1))
            slices.append(slice(offset, offset + length))
        return slices[0], slices[1]

    def _crop(
        self,
        crops: BackgroundCrops,
        size: tuple[int, int],
        rng: np.random.Generator,
        other: Backgrounds,
    ) -> UInt8[np.ndarray, "rows columns 3"] | None:
        """Draw a crop from the image's background, smaller where it must be.

        Only where there is no background, or one of a single colour, another picture gives it.
        """
        crop = crops.largest(size, rng)
        if crop is not None:
            return crop
        for _ in range(self.max_draws):
            crop = _crop_of_other(other, crops.image.shape[:2], size, rng)
            if has_contrast(crop, self.min_contrast):
                return crop
        return None


def _length(patch: slice) -> int:
    return int(patch.stop - patch.start)


def _middle(patch: slice, length: int) -> slice:
    """Return the middle of a patch's rows or columns."""
    start = patch.start + (_length(patch) - length) // 2
    return slice(start, start + length)


def _crop_of_other(
    other: Backgrounds, shape: tuple[int, int], size: tuple[int, int], rng: np.random.Generator
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Crop (height, width) from another picture of the image's (height, width)."""
    picture = other.draw(rng, shape[1], shape[0])
    row = int(rng.integers(0, shape[0] - size[0] + 1))
    column = int(rng.integers(0, shape[1] - size[1] + 1))
    return np.asarray(picture[row : row + size[0], column : column + size[1]])
