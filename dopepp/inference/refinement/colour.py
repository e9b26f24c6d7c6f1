"""Colours inside a part's outline against those around it: how much each pixel looks like the part.

Both are histograms of 16 steps a channel, blurred a little, and the answer is the logarithm of
their ratio at a pixel's colour. A colour that neither has seen says nothing. A part may be of
several colours and lie before several: each tile of its box counts its own and its neighbours'
pixels most, and the others a little (local histograms, Lankton and Tannenbaum 2008; RBOT).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from dopepp.core.compiled import Array, Scalar, compiled
from dopepp.geometry.camera import CameraMatrix, crop_camera, resize_camera

SMALLEST_PX: Final = 12  # A part that is shorter on the picture shows no outline
MARGIN: Final = 0.35  # of the part's extent, looked at around it
EDGE_PX: Final = 6.0  # looked at around it besides: an outline is looked for no nearer
STEPS: Final = 16  # of a channel
UNSEEN: Final = 0.3  # pixels of each colour that both histograms have from the start

KNOWN: Final = 100.0
"""Pixels that the whole part's colours, and those all around, count for in each tile."""

MOST: Final = 3.0
"""Bound of the logarithm: no colour proves more than 20 to 1, because colours come in patches."""

LONGEST_PX: Final = 250  # of larger pictures, not every pixel is counted
FEWEST: Final = 60  # pixels that a histogram needs


@dataclass(frozen=True, eq=False)
class Crop:
    """A piece of a picture."""

    colours: UInt8[np.ndarray, "height width 3"]  # RGB
    K: CameraMatrix  # its camera matrix, pixels
    extent: float  # longer side of the part on it, pixels
    scale: float  # its pixels per pixel of the picture: 1 over a whole number

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.colours.shape[1], self.colours.shape[0]

    @cached_property
    def bins(self) -> Int[np.ndarray, "height width"]:
        """The colours as one number a pixel; of rounds that are left out, nobody asks for it."""
        return colour_bins(self.colours)


def crop_around(
    image: UInt8[np.ndarray, "height width 3"],
    K: CameraMatrix,
    corners: Float[np.ndarray, "2 2"],
    longest_px: int,
) -> Crop | str:
    """Cut out a posed part and what is around it; where there is too little, say so.

    Args:
        image: RGB.
        K: Its camera matrix, pixels.
        corners: The upper left and the lower right one of the part's box on it.
        longest_px: About so long is the part on the crop at most.
    """
    lower, upper = corners
    extent = float((upper - lower).max())
    if extent < SMALLEST_PX:
        return f"the part is only {extent:.0f} pixels long"
    edge = MARGIN * extent + EDGE_PX
    limit = np.array(image.shape[1::-1])
    left, top = np.clip(np.floor(lower - edge), 0, limit).astype(int)
    right, bottom = np.clip(np.ceil(upper + edge) + 1, 0, limit).astype(int)
    if min(right - left, bottom - top) < SMALLEST_PX:
        return "the part lies outside the picture"
    # Whole numbers of pixels become one: that is exact, and many times faster than any other share.
    most = min(right - left, bottom - top) // SMALLEST_PX
    few = min(max(1, round(extent / longest_px)), most)
    width, height = (right - left) // few, (bottom - top) // few
    colours = image[top : top + few * height, left : left + few * width]
    own = crop_camera(K, left, top)
    if few == 1:
        colours = colours.copy()  # one kind of array, whose inner loops are compiled once
    else:
        own = resize_camera(own, 1 / few, 1 / few)
        colours = cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA)
    return Crop(colours, own, extent / few, 1 / few)


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
    tiles: int,
) -> Float32[np.ndarray, "height width"] | None:
    """Return the logarithm of part against surroundings for every pixel.

    Args:
        bins: The colours.
        mask: 1 where the part is taken to be.
        unsure: Pixels on both sides of the outline that count for neither.
        ring: Width of the surroundings, pixels.
        tiles: Along each side of the part's box; each has colours of its own.

    Returns:
        None where one of them has too few pixels on the picture.
    """
    thinned = math.ceil(max(mask.shape) / LONGEST_PX)
    few, unsure, ring = mask[::thinned, ::thinned], unsure / thinned, ring / thinned
    within = cv2.distanceTransform(np.ascontiguousarray(few), cv2.DIST_L2, 3)
    beyond = cv2.distanceTransform(1 - few, cv2.DIST_L2, 3)
    # A slender part keeps the inner half of its width.
    unsure_within = min(unsure, 0.5 * float(within.max()))
    left, top, width, height = cv2.boundingRect(few)
    columns = _tile_of(bins.shape[1], left * thinned, width * thinned, tiles)
    rows = _tile_of(bins.shape[0], top * thinned, height * thinned, tiles)
    counts = np.zeros((2, tiles, tiles, STEPS**3), np.float32)
    counted = _count(
        bins[::thinned, ::thinned], within, beyond, unsure_within, unsure, unsure + ring,
        rows[::thinned], columns[::thinned], counts,
    )  # fmt: skip
    if counted < FEWEST:
        return None
    tables = np.empty((tiles, tiles, STEPS**3), np.float32)
    _tables(counts, tables)
    odds = np.empty(bins.shape, np.float32)
    _look_up(bins, rows, columns, tables, odds)
    return odds


def _tile_of(length: int, start: int, extent: int, tiles: int) -> Int[np.ndarray, "length"]:
    """Return the tile of each place along a side; those before and beyond the box are its ends'."""
    return np.clip((np.arange(length) - start) * tiles // max(extent, 1), 0, tiles - 1)


@compiled()
def _bins(image: Array, bins: Array) -> None:
    for v in range(bins.shape[0]):
        for u in range(bins.shape[1]):
            r, g, b = image[v, u, 0] >> 4, image[v, u, 1] >> 4, image[v, u, 2] >> 4
            bins[v, u] = (r * 16 + g) * 16 + b


@compiled()
def _count(
    bins: Array,
    within: Array,
    beyond: Array,
    nearest_within: float,
    nearest: float,
    farthest: float,
    rows: Array,
    columns: Array,
    counts: Array,
) -> int:
    """Count the colours of the part and around it in every tile; return how many the fewer are."""
    inside = outside = 0
    for v in range(bins.shape[0]):
        for u in range(bins.shape[1]):
            if within[v, u] > nearest_within:
                counts[0, rows[v], columns[u], bins[v, u]] += 1.0
                inside += 1
            elif nearest < beyond[v, u] <= farthest:
                counts[1, rows[v], columns[u], bins[v, u]] += 1.0
                outside += 1
    return min(inside, outside)


@compiled()
def _tables(counts: Array, tables: Array) -> None:
    """Write the logarithm of the ratio for every tile and colour; ``counts`` are blurred."""
    tiles = counts.shape[1]
    known, near = np.empty((2, STEPS**3), np.float32), np.empty((2, STEPS**3), np.float32)
    for side in range(2):
        for k in range(STEPS**3):
            known[side, k] = UNSEEN
        for i in range(tiles):
            for j in range(tiles):
                _blur(counts[side, i, j])
                for k in range(STEPS**3):
                    known[side, k] += counts[side, i, j, k]
        factor = KNOWN / _sum(known[side])
        for k in range(STEPS**3):
            known[side, k] *= factor
    for i in range(tiles):
        for j in range(tiles):
            for side in range(2):
                for k in range(STEPS**3):
                    near[side, k] = known[side, k]
                for a in range(max(0, i - 1), min(tiles, i + 2)):
                    for b in range(max(0, j - 1), min(tiles, j + 2)):
                        share = np.float32(0.5 ** (abs(a - i) + abs(b - j)))
                        for k in range(STEPS**3):
                            near[side, k] += share * counts[side, a, b, k]
            level = math.log(_sum(near[1]) / _sum(near[0]))
            for k in range(STEPS**3):
                odds = level + math.log(near[0, k] / near[1, k])
                tables[i, j, k] = min(max(odds, -MOST), MOST)


@compiled()
def _look_up(bins: Array, rows: Array, columns: Array, tables: Array, odds: Array) -> None:
    for v in range(bins.shape[0]):
        for u in range(bins.shape[1]):
            odds[v, u] = tables[rows[v], columns[u], bins[v, u]]


@compiled()
def _sum(row: Array) -> Scalar:
    total = np.float32(0.0)
    for k in range(len(row)):
        total += row[k]
    return total


@compiled()
def _blur(counts: Array) -> None:
    """Blur a histogram by (1, 2, 1)/4 along all three channels."""
    for a in range(STEPS):
        for b in range(STEPS):
            rows = (((a * STEPS + b) * STEPS, 1), (a * STEPS * STEPS + b, STEPS))
            for first, stride in rows:  # numba would compile a call for each constant stride
                _blur_row(counts, first, stride)
    for a in range(STEPS):
        for b in range(STEPS):
            _blur_row(counts, a * STEPS + b, STEPS * STEPS)


@compiled()
def _blur_row(counts: Array, first: int, stride: int) -> None:
    before = counts[first]
    for i in range(STEPS):
        own = counts[first + i * stride]
        after = counts[first + min(i + 1, STEPS - 1) * stride]
        counts[first + i * stride] = 0.25 * before + 0.5 * own + 0.25 * after
        before = own
