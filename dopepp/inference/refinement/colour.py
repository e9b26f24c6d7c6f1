"""Colours inside a part's outline against those around it: how much each pixel looks like the part.

Both are histograms of 16 steps a channel, blurred a little, and the answer is the logarithm of
their ratio at a pixel's colour. A colour that neither has seen says nothing.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float32, Int, UInt8

from dopepp.core.compiled import Array, compiled

STEPS: Final = 16
"""Of a channel."""

UNSEEN: Final = 20.0
"""Pixels of any colour that both histograms have from the start."""

MOST: Final = 3.0
"""Bound of the logarithm: no colour proves more than 20 to 1, because colours come in patches."""

LONGEST_PX: Final = 250
"""Of larger pictures, not every pixel is counted."""

FEWEST: Final = 60
"""Pixels that a histogram needs."""


def colour_bins(
    image: UInt8[np.ndarray, "height width 3"],
) -> Int[np.ndarray, "height width"]:
    """Return each pixel's colour as one number below 4096."""
    bins = np.empty(image.shape[:2], np.int16)
    _bins(image, bins)
    return bins


def log_odds(
    bins: Int[np.ndarray, "height width"],
    mask: UInt8[np.ndarray, "height width"],
    unsure: float,
    ring: float,
) -> Float32[np.ndarray, "height width"] | None:
    """Return the logarithm of part against surroundings for every pixel.

    Args:
        bins: The colours.
        mask: 1 where the part is taken to be.
        unsure: Pixels on both sides of the outline that count for neither.
        ring: Width of the surroundings, pixels.

    Returns:
        None where one of them has too few pixels on the picture.
    """
    table = np.empty(STEPS**3, np.float32)
    thinned = math.ceil(max(mask.shape) / LONGEST_PX)
    few, unsure, ring = mask[::thinned, ::thinned], unsure / thinned, ring / thinned
    within = cv2.distanceTransform(np.ascontiguousarray(few), cv2.DIST_L2, 3)
    beyond = cv2.distanceTransform(1 - few, cv2.DIST_L2, 3)
    # A slender part keeps the inner half of its width.
    unsure_within = min(unsure, 0.5 * float(within.max()))
    few_bins = bins[::thinned, ::thinned]
    if not _table(few_bins, within, beyond, unsure_within, unsure, unsure + ring, table):
        return None
    return np.asarray(table.take(bins))


@compiled()
def _bins(image: Array, bins: Array) -> None:
    for v in range(bins.shape[0]):
        for u in range(bins.shape[1]):
            r, g, b = image[v, u, 0] >> 4, image[v, u, 1] >> 4, image[v, u, 2] >> 4
            bins[v, u] = (r * 16 + g) * 16 + b


@compiled()
def _table(
    bins: Array,
    within: Array,
    beyond: Array,
    nearest_within: float,
    nearest: float,
    farthest: float,
    table: Array,
) -> bool:
    """Write the logarithm of the ratio for every colour; False where pixels are too few."""
    counts = np.zeros((2, STEPS, STEPS, STEPS))
    flat = counts.reshape(2, STEPS**3)
    inside = outside = 0
    for v in range(bins.shape[0]):
        for u in range(bins.shape[1]):
            if within[v, u] > nearest_within:
                flat[0, bins[v, u]] += 1.0
                inside += 1
            elif nearest < beyond[v, u] <= farthest:
                flat[1, bins[v, u]] += 1.0
                outside += 1
    if inside < FEWEST or outside < FEWEST:
        return False
    _blur(counts[0])
    _blur(counts[1])
    for i in range(STEPS**3):
        part = (flat[0, i] + UNSEEN / 64) / (inside + UNSEEN)
        around = (flat[1, i] + UNSEEN / 64) / (outside + UNSEEN)
        table[i] = min(max(math.log(part / around), -MOST), MOST)
    return True


@compiled()
def _blur(counts: Array) -> None:
    """Blur by (1, 2, 1)/4 along all three channels."""
    for a in range(STEPS):
        for b in range(STEPS):
            _blur_row(counts[a, b])
            _blur_row(counts[a, :, b])
    for a in range(STEPS):
        for b in range(STEPS):
            _blur_row(counts[:, a, b])


@compiled()
def _blur_row(row: Array) -> None:
    before = row[0]
    for i in range(STEPS):
        own = row[i]
        after = row[min(i + 1, STEPS - 1)]
        row[i] = 0.25 * before + 0.5 * own + 0.25 * after
        before = own
