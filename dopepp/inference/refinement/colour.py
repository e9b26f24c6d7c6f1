"""Colours of the part and its surroundings: the log odds that a pixel shows the part.

Colours inside and around the outline are counted in two slightly blurred histograms with 16 bins
per channel. The log odds of a pixel are the logarithm of their ratio at the pixel's colour, and 0
if neither histogram contains the colour. Part and background may have several colours. Therefore
each tile of the part's box has its own histograms, in which the other tiles have a small weight
(Lankton and Tannenbaum 2008; RBOT).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from dopepp.core.compiled import Array, Scalar, compiled
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, crop_camera, resize_camera
from dopepp.inference.refinement.solver import UndecidedError

SMALLEST_PX: Final = 12  # length below which a part shows no outline
MARGIN: Final = 0.35  # margin of a crop, share of the part's extent
EDGE_PX: Final = 6.0  # additional margin: the smallest search distance of an outline
STEPS: Final = 16  # bins per channel
INITIAL_COUNT: Final = 0.3  # initial count of each colour in both histograms

GLOBAL_WEIGHT: Final = 100.0
"""Weight of the histogram of all tiles in each tile's histogram, in counted pixels."""

MAX_LOG_ODDS: Final = 3.0
"""Bound of the log odds (20 to 1), because neighbouring pixels are not independent."""

LONGEST_PX: Final = 250  # length above which the pixels of a crop are subsampled
FEWEST: Final = 60  # smallest number of pixels of a histogram


@dataclass(frozen=True, eq=False)
class Crop:
    """A part and its surroundings, cut from an image and shrunk.

    Colours are computed on first use, because a refinement round may be skipped.
    """

    region: RGBImage  # pixels of the image; the sides are multiples of `factor`
    factor: int  # image pixels per crop pixel
    K: CameraMatrix  # camera matrix of the crop, pixels
    extent: float  # longer side of the part, pixels of the crop

    @property
    def scale(self) -> float:
        """Crop pixels per image pixel."""
        return 1 / self.factor

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.region.shape[1] // self.factor, self.region.shape[0] // self.factor

    @cached_property
    def colours(self) -> RGBImage:
        """RGB pixels of the crop."""
        if self.factor == 1:
            return self.region.copy()  # contiguous like a resized crop: kernels are compiled once
        return np.asarray(cv2.resize(self.region, self.size, interpolation=cv2.INTER_AREA))

    @cached_property
    def bins(self) -> Int[np.ndarray, "height width"]:
        """Colour bin of each pixel."""
        return colour_bins(self.colours)


def crop_around(
    image: RGBImage,
    K: CameraMatrix,
    corners: Float[np.ndarray, "2 2"],
    longest_px: int,
) -> Crop:
    """Cut out a posed part and its surroundings.

    Args:
        image: RGB.
        K: Camera matrix, pixels.
        corners: Upper left and lower right corner of the part's box, pixels.
        longest_px: Approximate upper limit of the part's length on the crop.

    Raises:
        UndecidedError: The part is too small or outside the image.
    """
    lower, upper = corners
    extent = float((upper - lower).max())
    if extent < SMALLEST_PX:
        raise UndecidedError(f"the part is only {extent:.0f} pixels long")
    edge = MARGIN * extent + EDGE_PX
    limit = np.array(image.shape[1::-1])
    left, top = np.clip(np.floor(lower - edge), 0, limit).astype(int)
    right, bottom = np.clip(np.ceil(upper + edge) + 1, 0, limit).astype(int)
    if min(right - left, bottom - top) < SMALLEST_PX:
        raise UndecidedError("the part lies outside the image")
    # Shrinking by an integer is exact, and much faster than by other factors.
    most = min(right - left, bottom - top) // SMALLEST_PX
    factor = min(max(1, round(extent / longest_px)), most)
    width, height = (right - left) // factor, (bottom - top) // factor
    region = image[top : top + factor * height, left : left + factor * width]
    K = crop_camera(K, left, top)
    if factor > 1:
        K = resize_camera(K, 1 / factor, 1 / factor)
    return Crop(region, factor, K, extent / factor)


def colour_bins(image: RGBImage) -> Int[np.ndarray, "height width"]:
    """Return each pixel's colour bin (four bits per channel, below 4096)."""
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
    """Return the log odds that each pixel shows the part and not its surroundings.

    Args:
        bins: Colour bin of each pixel.
        mask: 1 where the part covers the pixel at its assumed pose, else 0.
        unsure: Width of the band on each side of the outline that neither histogram counts, pixels.
        ring: Width of the surroundings, pixels.
        tiles: Tiles along each side of the part's box.

    Returns:
        Log odds in [-3, 3]; None if part or surroundings have too few pixels on the image.
    """
    thinned = math.ceil(max(mask.shape) / LONGEST_PX)  # use every n-th pixel of rows and columns
    reduced_mask, unsure, ring = mask[::thinned, ::thinned], unsure / thinned, ring / thinned
    left, top, width, height = cv2.boundingRect(reduced_mask)
    reach = math.ceil(1.1 * (unsure + ring)) + 2  # OpenCV's distances are up to 5 % too short
    counted = (
        slice(max(0, top - reach), top + height + reach),
        slice(max(0, left - reach), left + width + reach),
    )
    reduced_mask = np.ascontiguousarray(reduced_mask[counted])
    within = cv2.distanceTransform(reduced_mask, cv2.DIST_L2, 3)
    beyond = cv2.distanceTransform(1 - reduced_mask, cv2.DIST_L2, 3)
    # Of a slender part, at least the inner half of its width is counted.
    unsure_within = min(unsure, 0.5 * float(within.max()))
    columns = _tile_of(bins.shape[1], left * thinned, width * thinned, tiles)
    rows = _tile_of(bins.shape[0], top * thinned, height * thinned, tiles)
    counts = np.zeros((2, tiles, tiles, STEPS**3), np.float32)
    sparse = _TiledBins(
        np.ascontiguousarray(bins[::thinned, ::thinned][counted]),
        np.ascontiguousarray(rows[::thinned][counted[0]]),
        np.ascontiguousarray(columns[::thinned][counted[1]]),
    )
    if _count(sparse, within, beyond, (unsure_within, unsure, unsure + ring), counts) < FEWEST:
        return None
    tables = np.empty((tiles, tiles, STEPS**3), np.float32)
    _tables(counts, tables)
    odds = np.empty(bins.shape, np.float32)
    _look_up(_TiledBins(bins, rows, columns), tables, odds)
    return odds


class _TiledBins(NamedTuple):
    """Colour bins of an image that is divided into tiles."""

    bins: Int[np.ndarray, "height width"]  # colour bin of each pixel
    rows: Int[np.ndarray, "height"]  # tile of each row of pixels
    columns: Int[np.ndarray, "width"]  # tile of each column of pixels


def _tile_of(length: int, start: int, extent: int, tiles: int) -> Int[np.ndarray, "length"]:
    """Return each pixel's tile along an image side; outer tiles extend beyond the part's box."""
    return np.clip((np.arange(length) - start) * tiles // max(extent, 1), 0, tiles - 1)


@compiled()
def _bins(image: Array, bins: Array) -> None:
    """Write each pixel's colour bin to ``bins``: four bits per channel."""
    for v in range(bins.shape[0]):
        for u in range(bins.shape[1]):
            r, g, b = image[v, u, 0] >> 4, image[v, u, 1] >> 4, image[v, u, 2] >> 4
            bins[v, u] = (r * 16 + g) * 16 + b


@compiled()
def _count(
    tiled: _TiledBins,
    within: Array,
    beyond: Array,
    limits: tuple[float, float, float],
    counts: Array,
) -> int:
    """Count the colours of part and surroundings in each tile.

    Args:
        tiled: Colour bins.
        within: Distance of each pixel inside the mask from the border, pixels.
        beyond: Distance of each pixel outside the mask from the border, pixels.
        limits: Pixels of the part up to the first distance from the border are not counted, nor
            surrounding pixels up to the second and beyond the third.
        counts: Updated counts, (part or surroundings, tile rows, tile columns, bins).

    Returns:
        The smaller of the two numbers of counted pixels.
    """
    bins, rows, columns = tiled
    nearest_within, nearest, farthest = limits
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
    """Write the log odds that a pixel shows the part, per tile and colour.

    Args:
        counts: Histograms of the part and of its surroundings per tile, shape (2, tiles, tiles,
            colours); blurred in place.
        tables: Filled with the log odds, shape (tiles, tiles, colours).
    """
    tiles = counts.shape[1]
    total, near = np.empty((2, STEPS**3), np.float32), np.empty((2, STEPS**3), np.float32)
    for side in range(2):
        for k in range(STEPS**3):
            total[side, k] = INITIAL_COUNT
        for i in range(tiles):
            for j in range(tiles):
                _blur(counts[side, i, j])
                for k in range(STEPS**3):
                    total[side, k] += counts[side, i, j, k]
    sums = _sums(total[0], total[1])
    for side in range(2):
        factor = GLOBAL_WEIGHT / sums[side]
        for k in range(STEPS**3):
            total[side, k] *= factor
    for i in range(tiles):
        for j in range(tiles):
            for side in range(2):
                for k in range(STEPS**3):
                    near[side, k] = total[side, k]
                for a in range(max(0, i - 1), min(tiles, i + 2)):
                    for b in range(max(0, j - 1), min(tiles, j + 2)):
                        share = np.float32(0.5 ** (abs(a - i) + abs(b - j)))
                        for k in range(STEPS**3):
                            near[side, k] += share * counts[side, a, b, k]
            inside, outside = _sums(near[0], near[1])
            level = math.log(outside / inside)
            for k in range(STEPS**3):
                # Most colours have not been counted, and have the value of their neighbour.
                if k > 0 and near[0, k] == near[0, k - 1] and near[1, k] == near[1, k - 1]:
                    tables[i, j, k] = tables[i, j, k - 1]
                    continue
                odds = level + math.log(near[0, k] / near[1, k])
                tables[i, j, k] = min(max(odds, -MAX_LOG_ODDS), MAX_LOG_ODDS)


@compiled()
def _look_up(tiled: _TiledBins, tables: Array, odds: Array) -> None:
    """Write the log odds that each pixel shows the part, from the colour table of its tile.

    Args:
        tiled: Colour bins.
        tables: Log odds, shape (tiles, tiles, colours).
        odds: Filled with the log odds, shape (height, width).
    """
    bins, rows, columns = tiled
    for v in range(bins.shape[0]):
        tables_of_row = tables[rows[v]]
        for u in range(bins.shape[1]):
            odds[v, u] = tables_of_row[columns[u], bins[v, u]]


@compiled()
def _sums(first: Array, second: Array) -> tuple[Scalar, Scalar]:
    """Return the sums of two rows in float32; one loop for both takes the time of one sum."""
    total, other = np.float32(0.0), np.float32(0.0)
    for k in range(len(first)):
        total += first[k]
        other += second[k]
    return total, other


@compiled()
def _blur(counts: Array) -> None:
    """Blur a histogram by (1, 2, 1)/4 along all three channels; empty lines remain empty."""
    plane = STEPS * STEPS
    sums = np.zeros(plane, np.float32)  # of the lines along the first channel
    for a in range(STEPS):
        is_empty = True
        for k in range(plane):
            is_empty &= counts[a * plane + k] == 0.0
        if is_empty:
            continue
        for b in range(STEPS):
            rows = ((a * plane + b * STEPS, 1), (a * plane + b, STEPS))
            for first, stride in rows:  # numba would compile a call for each constant stride
                _blur_row(counts, first, stride)
        for k in range(plane):
            sums[k] += counts[a * plane + k]
    for k in range(plane):
        if sums[k] > 0.0:
            _blur_row(counts, k, plane)


@compiled()
def _blur_row(counts: Array, first: int, stride: int) -> None:
    """Blur one line of a histogram by (1, 2, 1)/4 in place."""
    before = counts[first]
    for i in range(STEPS):
        count = counts[first + i * stride]
        after = counts[first + min(i + 1, STEPS - 1) * stride]
        counts[first + i * stride] = 0.25 * before + 0.5 * count + 0.25 * after
        before = count
