"""From the peaks of one object's maps to groups of keypoints, one group per instance.

Which corners belong together, an affine camera tells: from far enough away, a corner's image is
c + A s with the centroid's c, a 2×3 matrix A and the corner's signs s, so any three corners no two
of which are opposite predict the other five.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.cuboid import CENTROID, CORNER_SIGNS, NUM_CORNERS, NUM_KEYPOINTS

Evidence = Float[np.ndarray, "instances 8 peaks"]
CornerPeaks = Float[np.ndarray, "8 peaks 2"]
Corners = Float[np.ndarray, "instances 8 2"]

LEAST_DEVIATION: Final = 0.05
"""Radians by which even a clear vector may be off its centroid's direction."""

POSITION_PX: Final = 1.0
"""Error of a peak's and a centroid's positions, as far as it turns the direction between them."""

LEAST_LENGTH: Final = 1e-3
"""Of a mean vector; a shorter one has no direction."""

PREDICTION_PX: Final = 4.0
"""Deviation of a measured keypoint from where the other ones put it: half a cell of stride 8."""

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


@dataclass(frozen=True)
class ObjectPeaks:
    """The peaks of one object's corners and its centroids.

    Attributes:
        position: (x, y) of corners 0–7, input pixels; NaN in slots without a peak.
        score: Belief at the peak; 0 in slots without one.
        covariance_px: Of the position, pixels².
        toward: The field's mean vector at the peak, pointing to the centroid; the shorter, the
            less certain its direction.
        centroid: (x, y) of centroids.
        centroid_score: Their beliefs.
        centroid_covariance_px: Of their positions.
        area_px: Of the maps, pixels².
    """

    position: CornerPeaks
    score: Float[np.ndarray, "8 peaks"]
    covariance_px: Float[np.ndarray, "8 peaks 2 2"]
    toward: CornerPeaks
    centroid: Float[np.ndarray, "instances 2"]
    centroid_score: Float[np.ndarray, "instances"]
    centroid_covariance_px: Float[np.ndarray, "instances 2 2"]
    area_px: float


@dataclass(frozen=True)
class KeypointGroup:
    """The keypoints of one instance; NaN positions and zero scores where a corner is missing."""

    position: Float[np.ndarray, "9 2"]
    score: Float[np.ndarray, "9"]
    covariance_px: Float[np.ndarray, "9 2 2"]


def direction_evidence(peaks: ObjectPeaks, max_angle: float, coincident_px: float) -> Evidence:
    """Say how much belief and direction speak for each corner peak to belong to each centroid.

    The angle's likelihood is taken over that of any angle, so that a vector without a direction
    speaks for nobody. Unit vectors whose angles deviate by σ have a mean of length exp(−σ²/2).

    At most ``max_angle`` (radians) may lie between them for a corner to belong to a centroid; one
    within ``coincident_px`` of it has no direction, and any angle will do. Returned are
    log-likelihood ratios; −∞ where a pair is not allowed.
    """
    return _direction_evidence(
        peaks.position, peaks.score, peaks.toward, peaks.centroid, peaks.centroid_score, max_angle,
        coincident_px,
    )  # fmt: skip


def associate(
    peaks: ObjectPeaks, evidence: Evidence, expected: Corners | None = None
) -> list[KeypointGroup]:
    """Group peaks into instances, one per centroid.

    Per corner, peaks are assigned to centroids one-to-one by the greatest total evidence: that of
    belief and direction, and that of the distance from where the instance's other corners put it.
    The latter binds the corners together. A peak that nothing speaks for stays alone.

    ``expected`` is where poses found before put the corners, pixels; NaN for an instance without a
    pose. Before there are any, triples of corners predict the others.
    """
    deviation = np.full(len(evidence), PREDICTION_PX)
    if expected is None:
        expected, deviation = _predict(peaks, evidence)
    gain = _gain(evidence, peaks.position, peaks.covariance_px, expected, deviation, peaks.area_px)
    count = len(evidence)
    position = np.full((count, NUM_KEYPOINTS, 2), np.nan)
    covariance = np.full((count, NUM_KEYPOINTS, 2, 2), np.nan)
    score = np.zeros((count, NUM_KEYPOINTS))
    position[:, CENTROID] = peaks.centroid
    covariance[:, CENTROID] = peaks.centroid_covariance_px
    score[:, CENTROID] = peaks.centroid_score
    for k in range(NUM_CORNERS):
        instance, peak = linear_sum_assignment(gain[:, k], maximize=True)
        wanted = gain[instance, k, peak] > 0
        instance, peak = instance[wanted], peak[wanted]
        position[instance, k] = peaks.position[k, peak]
        covariance[instance, k] = peaks.covariance_px[k, peak]
        score[instance, k] = peaks.score[k, peak]
    return [KeypointGroup(*group) for group in zip(position, score, covariance, strict=True)]


@compiled()
def _direction_evidence(
    position: Array,
    score: Array,
    toward: Array,
    centroid: Array,
    centroid_score: Array,
    max_angle: float,
    coincident_px: float,
) -> Array:
    """Return the evidence of every instance, corner and peak."""
    evidence = np.full((len(centroid), *score.shape), -math.inf)
    for i, k, m in np.ndindex(evidence.shape):
        if not score[k, m] > 0.0:
            continue
        x, y = centroid[i, 0] - position[k, m, 0], centroid[i, 1] - position[k, m, 1]
        u, v = toward[k, m, 0], toward[k, m, 1]
        distance = math.hypot(x, y)
        angle, length = abs(math.atan2(x * v - y * u, x * u + y * v)), math.hypot(u, v)
        # A vector that is no number, as of a network that diverged, points nowhere.
        if not (math.isfinite(angle) and length >= LEAST_LENGTH):
            angle, length = math.pi, LEAST_LENGTH
        variance = LEAST_DEVIATION**2 - 2 * math.log(min(length, 1.0))
        variance += (POSITION_PX / max(distance, POSITION_PX)) ** 2
        ratio = -(angle**2) / (2 * variance) - min(0.5 * math.log(variance / (2 * math.pi)), 0.0)
        if distance < coincident_px:
            ratio = max(ratio, 0.0)
        elif angle > max_angle:
            continue
        evidence[i, k, m] = ratio + math.log(score[k, m]) + math.log(centroid_score[i])
    return evidence


@compiled()
def _gain(
    evidence: Array,
    position: Array,
    covariance_px: Array,
    expected: Array,
    deviation: Array,
    area_px: float,
) -> Array:
    """Add what the distance from the expected place says; 0 where all speaks against a pair.

    It is the ratio of a Gaussian's density there to that of a peak anywhere on the maps. Without
    an expectation the pair may be anywhere, which is what a ratio of 1 says.
    """
    gain = np.zeros(evidence.shape)
    for i, k, m in np.ndindex(evidence.shape):
        if not evidence[i, k, m] > -math.inf:
            continue
        value = evidence[i, k, m]
        if math.isfinite(expected[i, k, 0]):
            variance = deviation[i] ** 2
            variance += 0.5 * (covariance_px[k, m, 0, 0] + covariance_px[k, m, 1, 1])
            x, y = position[k, m, 0] - expected[i, k, 0], position[k, m, 1] - expected[i, k, 1]
            value += math.log(area_px / (2 * math.pi * variance)) - (x * x + y * y) / (2 * variance)
        if value > 0.0:
            gain[i, k, m] = value
    return gain


def _predict(
    peaks: ObjectPeaks, evidence: Evidence
) -> tuple[Corners, Float[np.ndarray, "instances"]]:
    """Find for each centroid the corners that the most and likeliest peaks agree on.

    A peak that belongs to nobody may lie anywhere on the maps. Returned are the corners' expected
    positions, NaN where no three peaks have a say, and the standard deviation from them, pixels.
    """
    order = np.argsort(-evidence, axis=-1)[..., :CANDIDATES]
    likeliest = np.take_along_axis(evidence, order, axis=-1)
    candidates = np.take_along_axis(peaks.position[None], order[..., None], axis=2)
    expected = np.full((len(evidence), NUM_CORNERS, 2), np.nan)
    deviation = np.empty(len(evidence))
    for i in range(len(evidence)):
        deviation[i] = _best_triple(
            candidates[i], likeliest[i], peaks.centroid[i], TRIPLES, WEIGHTS, PREDICTION_PX,
            peaks.area_px, expected[i],
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
