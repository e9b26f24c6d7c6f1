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


class Shifts(NamedTuple):
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
    samples = _Samples(contour.pixels, contour.normals, step, max(2, round(reach / step)))
    shifts = Shifts(np.empty(len(contour)), np.empty(len(contour)))
    _shifts(odds, samples, _changes(colours, samples), weights, shifts)
    return shifts


class _Samples(NamedTuple):
    """Positions along the normals of an outline at which the image is sampled."""

    pixels: Float[np.ndarray, "points 2"]  # points of the outline
    normals: Float[np.ndarray, "points 2"]  # outward unit normals
    step: float  # distance between samples, pixels
    per_side: int  # number of samples to either side of a point


@compiled()
def _changes(colours: Array, positions: _Samples) -> Array:
    """Measure how much the image changes between neighbouring samples along each normal.

    A change is the difference between the mean of the next two samples and the mean of the previous
    two, in the channel in which this difference is largest.

    Returns:
        The 2·per_side + 2 changes of each point, divided by the mean change plus ``MIN_CHANGE``.
    """
    pixels, normals, step, per_side = positions
    changes = np.empty((len(pixels), 2 * per_side + 2))
    height, width = colours.shape[:2]
    samples = np.empty((2 * per_side + 5, 3))
    total = 0.0
    for i in range(len(pixels)):
        for k in range(len(samples)):
            along = (k - per_side - 2) * step
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
        for k in range(2 * per_side + 2):
            most = 0.0
            for c in range(3):
                before = samples[k, c] + samples[k + 1, c]
                most = max(most, abs(samples[k + 2, c] + samples[k + 3, c] - before))
            changes[i, k] = 0.25 * most
            total += changes[i, k]
    strength = total / changes.size + MIN_CHANGE
    for i in range(len(pixels)):
        for k in range(2 * per_side + 2):
            changes[i, k] /= strength
    return changes


@compiled()
def _shifts(
    odds: Array, positions: _Samples, changes: Array, weights: Weights, shifts: Shifts
) -> None:
    """Fill ``shifts``, for the log odds of each pixel and the result of :func:`_changes`."""
    pixels, normals, step, per_side = positions
    sums = np.empty(2 * per_side + 2)
    # The part may end between any two samples, before the first or after the last.
    unknown = step * step * (len(sums) ** 2 - 1) / 12.0
    floor = MIN_DEVIATION**2 + step * step / 12.0
    for i in range(len(pixels)):
        before, most = 0.0, -math.inf
        for k in range(len(sums)):
            sums[k] = before + weights.edge * math.log(1.0 + changes[i, k] ** 2)
            most = max(most, sums[k])
            along = (k - per_side) * step
            before += weights.colour * _sampled(
                odds, pixels[i, 0] + along * normals[i, 0], pixels[i, 1] + along * normals[i, 1]
            )
        total = first = second = 0.0
        for k in range(len(sums)):
            sums[k] = math.exp(sums[k] - most)
            shift = (k - per_side - 0.5) * step
            total += sums[k]
            first += sums[k] * shift
            second += sums[k] * shift * shift
        mean = first / total
        variance = second / total - mean * mean
        # A shift beyond the search distance is not a measurement.
        inner = 1.0 - (sums[0] + sums[len(sums) - 1]) / total
        information = 1.0 / (variance + floor) - CHANCE / (unknown + floor)
        shifts.mean[i] = mean
        shifts.information[i] = max(0.0, information) * inner * inner


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
