"""Matching of all templates at all places of an image.

The score of a template is the sum of the responses at its points. Responses are rearranged so that
the responses of one point at all places of a grid are contiguous in memory, and a sum over places
is a sum of rows (Hinterstoisser et al. 2012). A score counts in standard deviations of the same
template over the image, because a template of a few straight lines scores high at many places.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dopepp.core.compiled import Array, compiled
from dopepp.inference.templates.responses import Responses
from dopepp.inference.templates.views import Templates

NUM_TURNS: Final = 24  # in the image plane, 15 degrees apart
STRIDE: Final = 4  # pixels between places
BANDS: Final = 4  # horizontal bands of the image; each gives one match of every template
TOGETHER: Final = 4  # rows that are added in one pass

Pose2d = Float[np.ndarray, "matches 4"]
"""Pixel of the part's centre, turn (radians) and projected diameter (pixels)."""


class Matches(NamedTuple):
    """Templates at places of an image."""

    views: Int[np.ndarray, "matches"]  # index of each template
    poses: Pose2d
    scores: Float[np.ndarray, "matches"]  # standard deviations above the template's mean
    means: Float[np.ndarray, "matches"]  # mean response of the template over the image
    deviations: Float[np.ndarray, "matches"]  # its standard deviation


def match(responses: Responses, templates: Templates, diameter_px: float) -> Matches:
    """Return the best places of every template and turn, one in each band of the image.

    Args:
        responses: Responses of the image.
        templates: Templates of the part.
        diameter_px: Diameter of the part on the image, pixels.
    """
    height, width = responses.shape[1:]
    rows, columns = -(-height // STRIDE), -(-width // STRIDE)
    reach = float(np.abs(templates.points).max()) * math.sqrt(2) * diameter_px
    margin = math.ceil(reach / STRIDE) + 1
    phases = _by_phase(responses, rows, columns, margin)
    shape = (len(templates.points), NUM_TURNS, BANDS)
    best, places = np.empty(shape, np.int16), np.empty(shape, np.int64)
    moments = np.empty((*shape[:2], 2))
    lines = templates.points, templates.normals
    _match(phases, rows, columns, margin, *lines, diameter_px, best, places, moments)
    means, deviations = np.repeat(moments.reshape(-1, 2), BANDS, axis=0).T
    view, turn, _ = (index.ravel() for index in np.indices(shape))
    v, u = np.divmod(places.ravel(), columns)
    poses = [
        STRIDE * u,
        STRIDE * v,
        turn * (2 * math.pi / NUM_TURNS),
        np.full(u.shape, diameter_px),
    ]
    return Matches(
        view,
        np.column_stack(poses),
        (best.ravel() - means) / deviations,
        means / templates.points.shape[1],
        deviations / templates.points.shape[1],
    )


def _by_phase(responses: Responses, rows: int, columns: int, margin: int) -> Responses:
    """Rearrange responses by orientation and by the remainders of row and column."""
    bins, height, width = responses.shape
    shape = bins, rows + 2 * margin, STRIDE, columns + 2 * margin, STRIDE
    padded = np.zeros((bins, shape[1] * STRIDE, shape[3] * STRIDE), np.int16)
    start = margin * STRIDE
    padded[:, start : start + height, start : start + width] = responses
    phases = padded.reshape(shape).transpose(0, 2, 4, 1, 3)
    return np.ascontiguousarray(phases.reshape(bins * STRIDE * STRIDE, -1))


@compiled()
def _add(flat: Array, starts: Array, total: Array) -> None:
    """Write the sum of rows of equal length that start at the given indices."""
    count = len(total)
    for p in range(0, len(starts), TOGETHER):
        a, b = flat[starts[p] : starts[p] + count], flat[starts[p + 1] : starts[p + 1] + count]
        c, d = (
            flat[starts[p + 2] : starts[p + 2] + count],
            flat[starts[p + 3] : starts[p + 3] + count],
        )
        if p == 0:
            for i in range(count):
                total[i] = np.int16(a[i] + b[i] + c[i] + d[i])
        else:
            for i in range(count):
                total[i] = np.int16(total[i] + a[i] + b[i] + c[i] + d[i])


@compiled(fastmath=True)
def _match(
    phases: Array,
    rows: int,
    columns: int,
    margin: int,
    points: Array,
    normals: Array,
    scale: float,
    best: Array,
    places: Array,
    moments: Array,
) -> None:
    """Write the best sum and place of every view, turn and band, and mean and deviation of sums."""
    bins, length = len(phases) // (STRIDE * STRIDE), phases.shape[1]
    turns, bands = best.shape[1:]
    across = columns + 2 * margin
    first = margin * across + margin
    flat, starts = phases.reshape(-1), np.empty(points.shape[1], np.int64)
    total = np.empty((rows - 1) * across + columns, np.int16)
    for view in range(len(points)):
        for turn in range(turns):
            angle = 2 * math.pi * turn / turns
            c, s = scale * math.cos(angle), scale * math.sin(angle)
            for p in range(points.shape[1]):
                u = int(np.rint(c * points[view, p, 0] - s * points[view, p, 1]))
                v = int(np.rint(s * points[view, p, 0] + c * points[view, p, 1]))
                b = int(np.rint((normals[view, p] + angle) * bins / math.pi)) % bins
                right, down = u // STRIDE, v // STRIDE
                phase = (b * STRIDE + v - down * STRIDE) * STRIDE + u - right * STRIDE
                starts[p] = phase * length + first + down * across + right
            _add(flat, starts, total)
            mean, square = 0.0, 0.0
            for r in range(rows):
                row_sum, row_square = 0, 0
                for k in range(r * across, r * across + columns):
                    row_sum += total[k]
                    row_square += np.int32(total[k]) * total[k]
                mean += row_sum
                square += row_square
            mean /= rows * columns
            moments[view, turn, 0] = mean
            moments[view, turn, 1] = math.sqrt(max(square / (rows * columns) - mean * mean, 1.0))
            for band in range(bands):
                best[view, turn, band], places[view, turn, band] = -32768, 0
                for r in range(rows * band // bands, rows * (band + 1) // bands):
                    row = total[r * across : r * across + columns]
                    most = row[0]
                    for k in range(columns):
                        most = max(most, row[k])
                    if most > best[view, turn, band]:
                        best[view, turn, band] = most
                        for k in range(columns):
                            if row[k] == most:
                                places[view, turn, band] = r * columns + k
                                break
