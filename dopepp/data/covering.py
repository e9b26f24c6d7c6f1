"""Covering an object with crops of the image's own background, never with a solid colour.

Training (:mod:`dopepp.data.masking`) and the shading protocol (:mod:`dopepp.data.shading`) differ
in where patches lie and how many there are; what a patch may show is decided here for both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from dopepp.data.sample import Instance

MIN_PATCH_PX: Final = 2
"""A patch of one pixel is a solid colour, whatever it shows."""

MIN_CONTRAST: Final = 3.0
"""A crop counts as solid when no colour channel's standard deviation reaches this many grey
levels."""

MAX_DRAWS: Final = 8
"""Crops drawn from a picture until one is not solid."""


class BackgroundCrops:
    """Draws crops of an image that show no object.

    Args:
        image: RGB, unpadded, so that padding is never taken as background.
        silhouettes: What each object covers; no crop touches any of it.
        min_contrast: See :data:`MIN_CONTRAST`.
        max_draws: See :data:`MAX_DRAWS`.
    """

    def __init__(
        self,
        image: UInt8[np.ndarray, "height width 3"],
        silhouettes: Sequence[Bool[np.ndarray, "height width"]],
        min_contrast: float = MIN_CONTRAST,
        max_draws: int = MAX_DRAWS,
    ) -> None:
        self.image, self.min_contrast, self.max_draws = image, min_contrast, max_draws
        occupied = np.zeros(image.shape[:2], bool)
        for seen in silhouettes:
            occupied |= seen
        self._integral = cv2.integral(occupied.astype(np.uint8))

    def draw(
        self, size: tuple[int, int], rng: np.random.Generator
    ) -> UInt8[np.ndarray, "rows columns 3"] | None:
        """Return a crop of (height, width), or None when a few draws gave none with contrast."""
        places = np.flatnonzero(self._is_free(size).ravel())
        for _ in range(self.max_draws if len(places) else 0):
            crop = self._crop(int(rng.choice(places)), size)
            if has_contrast(crop, self.min_contrast):
                return crop
        return None

    def search(
        self, size: tuple[int, int], rng: np.random.Generator
    ) -> UInt8[np.ndarray, "rows columns 3"] | None:
        """Return a crop of (height, width) with contrast, however rare they are.

        Where no crop has enough, as on a smooth background under small patches, one that is not of
        a single colour will do; None when there is none of these, either.
        """
        free = self._is_free(size)
        if not free.any():
            return None
        sums, squares = self._moments
        num = size[0] * size[1]
        # num²·variance: whole numbers below 2⁵³, so that a single colour gives exactly 0.
        spread = (num * _windows(squares, size) - _windows(sums, size) ** 2).max(axis=2)
        spread[~free] = 0
        for least in ((num * self.min_contrast) ** 2, 1.0):
            places = np.flatnonzero(spread.ravel() >= least)
            if len(places):
                return self._crop(int(rng.choice(places)), size)
        return None

    def largest(
        self, size: tuple[int, int], rng: np.random.Generator
    ) -> UInt8[np.ndarray, "rows columns 3"] | None:
        """Return a crop of (height, width), of half that where there is none, and so on.

        None where the background has no contrast at all, or no room for two pixels by two.
        """
        height, width = size
        while True:
            crop = self.draw((height, width), rng)
            if crop is None:
                crop = self.search((height, width), rng)
            if crop is not None or max(height, width) == MIN_PATCH_PX:
                return crop
            height, width = max(MIN_PATCH_PX, height // 2), max(MIN_PATCH_PX, width // 2)

    def _is_free(self, size: tuple[int, int]) -> Bool[np.ndarray, "rows columns"]:
        """Tell of the top left corner of every window whether it is free of objects."""
        return np.asarray(_windows(self._integral, size) == 0)

    @cached_property
    def _moments(self) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Integral images of the pixels and of their squares."""
        sums, squares = cv2.integral2(self.image, sdepth=cv2.CV_64F, sqdepth=cv2.CV_64F)
        return sums, squares

    def _crop(self, place: int, size: tuple[int, int]) -> UInt8[np.ndarray, "rows columns 3"]:
        """Return the window that is counted row by row."""
        row, column = divmod(place, self.image.shape[1] - size[1] + 1)
        return self.image[row : row + size[0], column : column + size[1]]


def _windows(integral: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the sum in every window of (height, width), from an integral image."""
    height, width = size
    return np.asarray(
        integral[height:, width:]
        - integral[:-height, width:]
        - integral[height:, :-width]
        + integral[:-height, :-width]
    )


def has_contrast(crop: UInt8[np.ndarray, "rows columns 3"], min_contrast: float) -> bool:
    """Tell whether a crop is more than a solid colour."""
    return float(crop.reshape(-1, 3).std(axis=0).max()) >= min_contrast


def covered_instance(
    instance: Instance,
    seen: Bool[np.ndarray, "height width"],
    covered: Bool[np.ndarray, "height width"],
) -> Instance:
    """Return an instance without the covered pixels; keypoints and pose stay as they are.

    Args:
        instance: Before covering.
        seen: Its silhouette before covering.
        covered: All covered pixels of the image.
    """
    before = int(np.count_nonzero(seen))
    if before == 0:
        return instance
    share = int(np.count_nonzero(seen & covered)) / before
    return replace(
        instance,
        mask=None if instance.mask is None else instance.mask & ~covered,
        visible_fraction=instance.visible_fraction * (1 - share),
        masked_fraction=share,
    )
