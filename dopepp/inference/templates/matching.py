"""Matching of all templates at all positions of an image.

The score of a template is the sum of the responses at its points. Responses are rearranged so that
the responses of one point at all positions of a grid are contiguous in memory. The scores at all
positions are then a sum of rows (Hinterstoisser et al. 2012). Responses are divided by
``QUANTUM``, so that a byte holds the sum of four of them, and only the first points of a template
are used, which are far apart.

Scores are normalised by the mean and standard deviation of the template's scores over the image,
because a template of a few straight lines scores high at many positions.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from dopepp.core.compiled import Array, compiled
from dopepp.inference.templates.responses import Responses
from dopepp.inference.templates.views import Templates

NUM_ROLLS: Final = 24  # in the image plane, 15 degrees apart
STRIDE: Final = 4  # pixels between positions
CELL: Final = 0.2  # side of a cell, diameters
NUM_KEPT: Final = 8  # number of best matches that each cell keeps
NUM_SUMMED: Final = 32  # number of a template's points that are used, a multiple of TOGETHER
TOGETHER: Final = 8  # rows that are added in one pass
LOWEST: Final = -1e9  # below all scores
QUANTUM: Final = 4  # unit of the summed responses
MOST: Final = 31  # largest quantised response

Pose2d = Float[np.ndarray, "matches 4"]
"""Pixel of the part's centre, in-plane rotation (radians) and projected diameter (pixels)."""


class Matches(NamedTuple):
    """Templates at positions of an image."""

    views: Int[np.ndarray, "matches"]  # index of each template
    poses: Pose2d
    scores: Float[np.ndarray, "matches"]  # standard deviations above the template's mean
    means: Float[np.ndarray, "matches"]  # mean response of the template over the image
    deviations: Float[np.ndarray, "matches"]  # standard deviation of this response over the image

    def at(self, rows: Int[np.ndarray, "rows"] | Bool[np.ndarray, "matches"]) -> Matches:
        """Return the matches that indices or a mask select."""
        return Matches(*(column[rows] for column in self))


def match(responses: Responses, templates: Templates, diameter_px: float) -> Matches:
    """Return the best matches of all templates and in-plane rotations in each cell of the image.

    Cells keep the matches diverse: a textured area can have thousands of matches with scores above
    the part's score.

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
    side = max(1, round(CELL * diameter_px / STRIDE))
    shape = (-(-rows // side), -(-columns // side), NUM_KEPT)
    scores, best = np.full(shape, -np.inf), np.zeros((*shape, 3), np.int64)
    moments = np.empty((len(templates.points), NUM_ROLLS, 2))
    points = np.ascontiguousarray(templates.points[:, :NUM_SUMMED])
    lines = points, np.ascontiguousarray(templates.normals[:, :NUM_SUMMED])
    _match(phases, rows, columns, margin, *lines, diameter_px, side, scores, best, moments)
    filled = np.isfinite(scores)
    views, rolls, positions = best[filled].T
    v, u = np.divmod(positions, columns)
    poses = [
        STRIDE * u,
        STRIDE * v,
        rolls * (2 * math.pi / NUM_ROLLS),
        np.full(u.shape, diameter_px),
    ]
    means, deviations = moments[views, rolls].T * (QUANTUM / points.shape[1])
    return Matches(views, np.column_stack(poses), scores[filled], means, deviations)


def _by_phase(
    responses: Responses, rows: int, columns: int, margin: int
) -> Int8[np.ndarray, "phases positions"]:
    """Rearrange quantised responses by orientation and by row and column modulo the stride.

    Args:
        responses: Responses of the image.
        rows: Number of positions from top to bottom.
        columns: Number of positions from left to right.
        margin: Number of positions added on each side of the image, with a response of 0.
    """
    bins, height, width = responses.shape
    shape = bins, rows + 2 * margin, STRIDE, columns + 2 * margin, STRIDE
    padded = np.zeros((bins, shape[1] * STRIDE, shape[3] * STRIDE), np.int8)
    start = margin * STRIDE
    quantised = (responses.astype(np.int16) + QUANTUM // 2) // QUANTUM
    quantised = np.minimum(quantised, MOST)  # the sum of four fits into a byte
    padded[:, start : start + height, start : start + width] = quantised
    phases = padded.reshape(shape).transpose(0, 2, 4, 1, 3)
    return np.ascontiguousarray(phases.reshape(bins * STRIDE * STRIDE, -1))


@compiled()
def _add(flat: Array, starts: Array, total: Array) -> None:
    """Write to ``total`` the sum of the rows of ``flat`` that start at the indices ``starts``."""
    count = len(total)
    for p in range(0, len(starts), TOGETHER):
        a, b = flat[starts[p] : starts[p] + count], flat[starts[p + 1] : starts[p + 1] + count]
        c, d = (
            flat[starts[p + 2] : starts[p + 2] + count],
            flat[starts[p + 3] : starts[p + 3] + count],
        )
        e, f = (
            flat[starts[p + 4] : starts[p + 4] + count],
            flat[starts[p + 5] : starts[p + 5] + count],
        )
        g, h = (
            flat[starts[p + 6] : starts[p + 6] + count],
            flat[starts[p + 7] : starts[p + 7] + count],
        )
        before = np.int16(p > 0)
        for i in range(count):
            low, high = np.int8(a[i] + b[i] + c[i] + d[i]), np.int8(e[i] + f[i] + g[i] + h[i])
            total[i] = np.int16(before * total[i] + low + high)


@compiled(fastmath=True)
def _match(
    phases: Array,
    rows: int,
    columns: int,
    margin: int,
    points: Array,
    normals: Array,
    scale: float,
    side: int,
    scores: Array,
    best: Array,
    moments: Array,
) -> None:
    """Write the best matches of all templates and in-plane rotations in each cell of the image.

    Args:
        phases: Result of :func:`_by_phase`.
        rows: Number of positions from top to bottom.
        columns: Number of positions from left to right.
        margin: Number of positions added around the image.
        points: Points of each view, diameters.
        normals: Direction of each point's normal, radians.
        scale: Projected diameter, pixels.
        side: Side of a cell, positions.
        scores: Filled with the scores of each cell's best matches.
        best: Filled with view, in-plane rotation and position of each match.
        moments: Filled with mean and standard deviation of each template's sums.
    """
    bins, length = len(phases) // (STRIDE * STRIDE), phases.shape[1]
    rolls, across = moments.shape[1], columns + 2 * margin
    first = margin * across + margin
    flat, starts = phases.reshape(-1), np.empty(points.shape[1], np.int64)
    total = np.empty((rows - 1) * across + columns, np.int16)
    highest, weakest = np.empty(columns, np.int16), np.zeros(scores.shape[:2], np.int64)
    bars = np.full((scores.shape[0], columns), LOWEST, np.float32)  # weakest score of each cell
    for view in range(len(points)):
        for roll in range(rolls):
            angle = 2 * math.pi * roll / rolls
            c, s = scale * math.cos(angle), scale * math.sin(angle)
            for p in range(points.shape[1]):
                u = int(np.rint(c * points[view, p, 0] - s * points[view, p, 1]))
                v = int(np.rint(s * points[view, p, 0] + c * points[view, p, 1]))
                b = int(np.rint((normals[view, p] + angle) * bins / math.pi)) % bins
                right, down = u // STRIDE, v // STRIDE
                phase = (b * STRIDE + v - down * STRIDE) * STRIDE + u - right * STRIDE
                starts[p] = phase * length + first + down * across + right
            _add(flat, starts, total)
            mean = square = 0.0
            for r in range(rows):
                row = total[r * across : r * across + columns]
                row_sum, row_square = np.float32(0.0), np.float32(0.0)
                for k in range(columns):
                    value = np.float32(row[k])
                    row_sum += value
                    row_square += value * value
                mean += float(row_sum)
                square += float(row_square)
            mean /= rows * columns
            deviation = math.sqrt(max(square / (rows * columns) - mean * mean, 1.0))
            moments[view, roll, 0], moments[view, roll, 1] = mean, deviation
            for i in range(scores.shape[0]):
                top, bottom = i * side, min((i + 1) * side, rows)
                highest[:] = total[top * across : top * across + columns]
                for r in range(top + 1, bottom):
                    row = total[r * across : r * across + columns]
                    for k in range(columns):
                        highest[k] = max(highest[k], row[k])
                bar, least, unit, passing = bars[i], np.float32(mean), np.float32(deviation), 0
                for k in range(columns):
                    passing += np.float32(highest[k]) - least > bar[k] * unit
                if not passing:  # a loop over all columns is much faster than one over cells
                    continue
                for j in range(scores.shape[1]):
                    left, right, slot = j * side, min((j + 1) * side, columns), weakest[i, j]
                    most = highest[left]
                    for k in range(left + 1, right):
                        most = max(most, highest[k])
                    score = (most - mean) / deviation
                    if score <= scores[i, j, slot]:
                        continue
                    position = 0
                    for r in range(top, bottom):
                        for k in range(left, right):
                            if total[r * across + k] == most:
                                position = r * columns + k
                    scores[i, j, slot] = score
                    best[i, j, slot, 0], best[i, j, slot, 1] = view, roll
                    best[i, j, slot, 2] = position
                    weakest[i, j] = np.argmin(scores[i, j])
                    bar[left:right] = max(scores[i, j, weakest[i, j]], LOWEST)
