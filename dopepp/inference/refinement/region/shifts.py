"""Shifts of the outline along its normals.

Along a normal, pixels have the part's colours up to the shift d at which the part ends, and the
colours of its surroundings beyond. The sum of the pixels' log odds up to d is therefore the
logarithm of the likelihood of d, up to a constant.

Edges also increase the likelihood: it is higher where the image changes more than on average. Edges
separate a part from surroundings of its own colour, and locate the border with subpixel accuracy.

The result is the mean of the shift and its information: the inverse of its variance, minus the
inverse variance of a uniform distribution. If all shifts are equally likely, the information is
zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, UInt8

from dopepp.core.compiled import Array, compiled
from dopepp.inference.refinement.outline import Contour

MIN_CHANGE: Final = 3.0  # grey levels of noise: smaller changes are not edges

CHANCE: Final = 1.2
"""Largest ratio of the variance of a uniform distribution to that measured on pure noise."""

MIN_DEVIATION: Final = 0.3  # pixels; lower bound for the position of an edge at one point


class Weights(NamedTuple):
    """Exponents of the likelihoods of colours and of edges along a normal."""

    colour: float  # exponent of a pixel's likelihood: neighbouring pixels are not independent
    edge: float  # exponent of an edge's likelihood: 1 + (change / mean change)²


FOUND: Final = Weights(colour=0.5, edge=1.0)
"""Weights for an inaccurate start pose: colours decide which of many edges is the part's border."""

JOINT: Final = Weights(colour=0.35, edge=2.0)
"""Weights for several views, which start near the correct pose."""

FOLLOWED: Final = Weights(colour=0.12, edge=4.0)
"""Weights for a tracked part: the nearest edge is the part's border, and blur does not shift the
edge's centre. For inaccurate start poses, these weights are worse than :data:`FOUND`."""


@dataclass(frozen=True, eq=False)
class Shifts:
    """Shift of the part's border on the image from a projected outline, along each normal."""

    mean: Float[np.ndarray, "points"]  # pixels, outward
    information: Float[np.ndarray, "points"]  # pixels⁻²; 0 where all shifts are equally likely


def find_shifts(
    odds: Float32[np.ndarray, "height width"],
    colours: UInt8[np.ndarray, "height width 3"],
    contour: Contour,
    reach: float,
    step: float,
    weights: Weights,
) -> Shifts:
    """Measure how far the part's border on the image is from an outline, along its normals.

    Args:
        odds: Log odds that each pixel shows the part; 0 where unknown.
        colours: RGB.
        contour: Outline.
        reach: Search distance to each side, pixels.
        step: Distance between samples, pixels.
        weights: Exponents of the likelihoods of colours and edges.
    """
    count = max(2, round(reach / step))
    changes = np.empty((len(contour), 2 * count + 2))
    strength = _changes(colours, contour.pixels, contour.normals, step, count, changes)
    shifts = np.empty((len(contour), 2))
    _shifts(odds, contour.pixels, contour.normals, changes, strength, step, count, *weights, shifts)
    return Shifts(shifts[:, 0], shifts[:, 1])


@compiled()
def _changes(
    colours: Array, pixels: Array, normals: Array, step: float, count: int, changes: Array
) -> float:
    """Measure how much the image changes between neighbouring samples along each normal.

    A change is the difference between the mean of the next two samples and the mean of the previous
    two, in the channel in which this difference is largest.

    Args:
        colours: RGB crop of the image.
        pixels: Points of the projected outline.
        normals: Outward unit normal of each point.
        step: Distance between samples, pixels.
        count: Number of samples to either side of a point.
        changes: Filled with the 2·count + 2 changes of each point, grey levels.

    Returns:
        The mean change plus ``MIN_CHANGE``, grey levels.
    """
    height, width = colours.shape[:2]
    samples = np.empty((2 * count + 5, 3))
    total = 0.0
    for i in range(len(pixels)):
        for k in range(len(samples)):
            along = (k - count - 2) * step
            u = min(max(0.0, pixels[i, 0] + along * normals[i, 0]), width - 1.001)
            v = min(max(0.0, pixels[i, 1] + along * normals[i, 1]), height - 1.001)
            column, row = int(u), int(v)
            a, b = u - column, v - row
            for c in range(3):
                above = (1.0 - a) * colours[row, column, c] + a * colours[row, column + 1, c]
                below = (1.0 - a) * colours[row + 1, column, c] + a * colours[
                    row + 1, column + 1, c
                ]
                samples[k, c] = (1.0 - b) * above + b * below
        for k in range(2 * count + 2):
            most = 0.0
            for c in range(3):
                before = samples[k, c] + samples[k + 1, c]
                most = max(most, abs(samples[k + 2, c] + samples[k + 3, c] - before))
            changes[i, k] = 0.25 * most
            total += changes[i, k]
    return total / changes.size + MIN_CHANGE


@compiled()
def _shifts(
    odds: Array,
    pixels: Array,
    normals: Array,
    changes: Array,
    strength: float,
    step: float,
    count: int,
    colour: float,
    edge: float,
    shifts: Array,
) -> None:
    """Estimate the shift of the part's border along each normal, and its information.

    Args:
        odds: Log odds of part against surroundings for every pixel.
        pixels: Points of the projected outline.
        normals: Outward unit normal of each point.
        changes: Change of the image between neighbouring samples of each normal.
        strength: Change that counts as an edge.
        step: Distance between samples, pixels.
        count: Number of samples to either side of a point.
        colour: Weight of the colours.
        edge: Weight of the edges.
        shifts: Filled with mean (pixels) and information (pixels⁻²) of each point.
    """
    sums = np.empty(2 * count + 2)
    # The part may end between any two samples, before the first or after the last.
    unknown = step * step * (len(sums) ** 2 - 1) / 12.0
    floor = MIN_DEVIATION**2 + step * step / 12.0
    for i in range(len(pixels)):
        before, most = 0.0, -math.inf
        for k in range(len(sums)):
            sums[k] = before + edge * math.log(1.0 + (changes[i, k] / strength) ** 2)
            most = max(most, sums[k])
            along = (k - count) * step
            before += colour * _sampled(
                odds, pixels[i, 0] + along * normals[i, 0], pixels[i, 1] + along * normals[i, 1]
            )
        total = first = second = 0.0
        for k in range(len(sums)):
            sums[k] = math.exp(sums[k] - most)
            shift = (k - count - 0.5) * step
            total += sums[k]
            first += sums[k] * shift
            second += sums[k] * shift * shift
        mean = first / total
        variance = second / total - mean * mean
        # A shift beyond the search distance is not a measurement.
        inner = 1.0 - (sums[0] + sums[len(sums) - 1]) / total
        information = 1.0 / (variance + floor) - CHANCE / (unknown + floor)
        shifts[i, 0] = mean
        shifts[i, 1] = max(0.0, information) * inner * inner


@compiled()
def _sampled(values: Array, u: float, v: float) -> float:
    """Interpolate values at column u and row v between four pixels; 0 outside the image."""
    height, width = values.shape
    if not (0.0 <= u < width - 1.0 and 0.0 <= v < height - 1.0):
        return 0.0
    i, j = int(u), int(v)
    a, b = u - i, v - j
    above = values[j, i] + a * (values[j, i + 1] - values[j, i])
    below = values[j + 1, i] + a * (values[j + 1, i + 1] - values[j + 1, i])
    return float(above + b * (below - above))
