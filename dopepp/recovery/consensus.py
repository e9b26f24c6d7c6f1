"""Which corners belong together: an affine camera seen through three of them, compiled.

From far enough away, a corner's image is c + A s with the centroid's c, a 2×3 matrix A and the
corner's signs s, so any three corners no two of which are opposite predict the other five.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.cuboid import CORNER_SIGNS, NUM_CORNERS

Evidence = Float[np.ndarray, "instances 8 peaks"]
CornerPeaks = Float[np.ndarray, "8 peaks 2"]
Corners = Float[np.ndarray, "instances 8 2"]

CANDIDATES: Final = 3
"""Peaks of a corner that are tried: the likeliest ones by belief and direction."""

PERSPECTIVE: Final = 0.1
"""Deviation of corners from the affine camera, over their distance from the centroid: a part seen
from five times its size away has corners ±10 % nearer or farther."""

TRIPLES: Final = np.array(
    [
        triple
        for triple in combinations(range(NUM_CORNERS), 3)
        if abs(np.linalg.det(CORNER_SIGNS[list(triple)])) > 1
    ]
)
"""Corners without an opposite pair, which would leave a direction open; (32, 3)."""

WEIGHTS: Final = np.array(
    [np.linalg.solve(CORNER_SIGNS[triple].T, CORNER_SIGNS.T).T for triple in TRIPLES]
)
"""Every corner as a sum of the triple's, relative to the centroid; (32, 8, 3)."""


def predict(
    position: CornerPeaks,
    evidence: Evidence,
    centroids: Float[np.ndarray, "instances 2"],
    deviation_px: float,
    area_px: float,
) -> tuple[Corners, Float[np.ndarray, "instances"]]:
    """Find for each centroid the corners that the most and likeliest peaks agree on.

    Evidence is the log-likelihood ratio of each peak to belong to each centroid, −∞ if it cannot.
    ``deviation_px`` is of a peak from where it should be, besides perspective; one that belongs to
    nobody may lie anywhere on ``area_px``.

    Returned are the corners' expected positions, NaN where no three peaks have a say, and the
    standard deviation from them, pixels.
    """
    order = np.argsort(-evidence, axis=-1)[..., :CANDIDATES]
    likeliest = np.take_along_axis(evidence, order, axis=-1)
    candidates = np.take_along_axis(position[None], order[..., None], axis=2)
    expected = np.full((len(centroids), NUM_CORNERS, 2), np.nan)
    deviation = np.full(len(centroids), deviation_px)
    for i in range(len(centroids)):
        deviation[i] = _best_triple(
            candidates[i], likeliest[i], centroids[i], TRIPLES, WEIGHTS, deviation_px, area_px,
            expected[i],
        )  # fmt: skip
    return expected, deviation


@compiled()
def _best_triple(
    candidates: Array,
    evidence: Array,
    centroid: Array,
    triples: Array,
    weights: Array,
    deviation_px: float,
    area_px: float,
    expected: Array,
) -> float:
    """Write the corners that the best three candidates predict; returns their deviation."""
    best, best_deviation = -math.inf, deviation_px
    # What speaks so much against a peak that no agreement makes up for it.
    hopeless = -math.log(area_px / (2 * math.pi * deviation_px**2))
    count = candidates.shape[1]
    corners, arms = np.empty((8, 2)), np.empty((3, 2))
    chosen = np.empty(3, np.int64)
    usable = np.zeros(8, np.int64)
    for k in range(8):
        # Candidates come likeliest first.
        while usable[k] < count and evidence[k, usable[k]] > hopeless:
            usable[k] += 1
    for number in range(len(triples)):
        a, b, c = usable[triples[number, 0]], usable[triples[number, 1]], usable[triples[number, 2]]
        for code in range(a * b * c):
            chosen[0], chosen[1], chosen[2] = code % a, code // a % b, code // (a * b)
            for i in range(3):
                arms[i] = candidates[triples[number, i], chosen[i]] - centroid
            size = 0.0
            for k in range(8):
                for axis in range(2):
                    arm = 0.0
                    for i in range(3):
                        arm += weights[number, k, i] * arms[i, axis]
                    corners[k, axis] = arm
                size += math.hypot(corners[k, 0], corners[k, 1]) / 8
            deviation = math.hypot(deviation_px, PERSPECTIVE * size)
            gain = math.log(area_px / (2 * math.pi * deviation**2))
            total = 0.0
            for k in range(8):
                most = 0.0
                for m in range(count):
                    dx = candidates[k, m, 0] - centroid[0] - corners[k, 0]
                    dy = candidates[k, m, 1] - centroid[1] - corners[k, 1]
                    miss = (dx * dx + dy * dy) / (2 * deviation**2)
                    value = evidence[k, m] + gain - miss
                    # A peak that does not exist has −∞ or NaN.
                    if value > most:
                        most = value
                total += most
            if total > best:
                best, best_deviation = total, deviation
                for k in range(8):
                    expected[k] = corners[k] + centroid
    return best_deviation
