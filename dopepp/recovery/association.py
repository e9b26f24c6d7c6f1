"""From the peaks of one object's maps to groups of keypoints, one group per instance.

Which corners belong together, an affine camera tells: from far enough away, a corner's image is
c + A s with the centroid's c, a 2×3 matrix A and the corner's signs s. Opposite corners have
opposite arms A s, and of the four diagonals' arms, three give the fourth: so any three corners no
two of which are opposite predict the other five.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # its parts load when they are used
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS

Evidence = Float[np.ndarray, "instances 8 peaks"]
CornerPeaks = Float[np.ndarray, "8 peaks 2"]
Corners = Float[np.ndarray, "instances 8 2"]

LEAST_DEVIATION: Final = 0.05
"""Radians by which even a clear vector may be off its centroid's direction."""

POSITION_PX: Final = 1.0
"""Error of positions, as far as it turns the direction between peak and centroid."""

LEAST_LENGTH: Final = 1e-3  # Of a mean vector; a shorter one has no direction

PREDICTION_PX: Final = 4.0  # Deviation of a keypoint from its prediction: half a cell of stride 8

CANDIDATES: Final = 3
"""Peaks of a corner that are tried: the likeliest ones by belief and direction."""

PERSPECTIVE: Final = 0.1
"""Deviation of corners from the affine camera, over their distance from the centroid: a part seen
from five times its size away has corners ±10 % nearer or farther."""

DIAGONALS: Final = np.array([(0, 6), (1, 7), (2, 4), (3, 5)])  # Opposite corners
RIVALS: Final = -2  # In place of a peak that two instances want

ALTERNATING: Final = np.array([1.0, -1.0, 1.0, -1.0])
"""The first corners' arms, signed so, sum to zero."""


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
    """Return how much belief and direction speak for each corner peak to belong to each centroid.

    The angle's likelihood is taken over that of any angle, so that a vector without a direction
    speaks for nobody. Unit vectors whose angles deviate by σ have a mean of length exp(−σ²/2).

    Args:
        peaks: Corner peaks and centroids.
        max_angle: Largest angle between a vector and its centroid, radians.
        coincident_px: Distance from a centroid within which any angle will do.

    Returns:
        Log-likelihood ratios; −∞ where a pair is not allowed.
    """
    return _direction_evidence(
        peaks.position, peaks.score, peaks.toward, peaks.centroid, peaks.centroid_score, max_angle,
        coincident_px,
    )  # fmt: skip


def associate(
    peaks: ObjectPeaks, evidence: Evidence, expected: Corners | None = None
) -> list[KeypointGroup]:
    """Group peaks into instances, one per centroid.

    Per corner, peaks are assigned to centroids one-to-one by the greatest total evidence: of belief
    and direction, and of the distance from where the instance's other corners predict it. A peak
    without evidence stays alone. ``expected`` is where poses put the corners, pixels, NaN for an
    instance without a pose; before there are any, triples of corners predict the others.
    """
    deviation = np.full(len(evidence), PREDICTION_PX)
    if expected is None:
        expected, deviation = _predict(peaks.position, evidence, peaks.centroid, peaks.area_px)
    gain = _gain(evidence, peaks.position, peaks.covariance_px, expected, deviation, peaks.area_px)
    count = len(evidence)
    position = np.full((count, NUM_KEYPOINTS, 2), np.nan)
    covariance = np.full((count, NUM_KEYPOINTS, 2, 2), np.nan)
    score = np.zeros((count, NUM_KEYPOINTS))
    position[:, CENTROID] = peaks.centroid
    covariance[:, CENTROID] = peaks.centroid_covariance_px
    score[:, CENTROID] = peaks.centroid_score
    chosen = _unrivalled(gain)
    for k in np.flatnonzero((chosen == RIVALS).any(0)):
        instance, peak = scipy.optimize.linear_sum_assignment(gain[:, k], maximize=True)
        chosen[:, k] = -1
        chosen[instance, k] = np.where(gain[instance, k, peak] > 0, peak, -1)
    instance, corner = np.nonzero(chosen >= 0)
    peak = chosen[instance, corner]
    position[instance, corner] = peaks.position[corner, peak]
    covariance[instance, corner] = peaks.covariance_px[corner, peak]
    score[instance, corner] = peaks.score[corner, peak]
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
    beliefs = np.log(centroid_score)
    for k, m in np.ndindex(score.shape):
        if not score[k, m] > 0.0:
            continue
        belief = math.log(score[k, m])
        u, v = toward[k, m, 0], toward[k, m, 1]
        length = math.sqrt(u * u + v * v)
        # A vector that is no number, as of a network that diverged, points nowhere.
        directed = LEAST_LENGTH <= length < math.inf
        spread = LEAST_DEVIATION**2 - 2 * math.log(min(length, 1.0) if directed else LEAST_LENGTH)
        for i in range(len(centroid)):
            x, y = centroid[i, 0] - position[k, m, 0], centroid[i, 1] - position[k, m, 1]
            distance = math.sqrt(x * x + y * y)
            angle = abs(math.atan2(x * v - y * u, x * u + y * v)) if directed else math.pi
            if angle > max_angle and not distance < coincident_px:
                continue
            variance = spread + (POSITION_PX / max(distance, POSITION_PX)) ** 2
            ratio = -(angle**2) / (2 * variance)
            ratio -= min(0.5 * math.log(variance / (2 * math.pi)), 0.0)
            if distance < coincident_px:
                ratio = max(ratio, 0.0)
            evidence[i, k, m] = ratio + belief + beliefs[i]
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
    """Add the evidence of the distance from the expected position; 0 where it is negative.

    It is the ratio of a Gaussian's density there to that of a peak anywhere on the maps, which is 1
    without an expectation.
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


@compiled()
def _unrivalled(gain: Array) -> Array:
    """Return instances' best peaks of each corner, −1 for none, or RIVALS where two want one."""
    chosen = np.full(gain.shape[:2], -1, np.int64)
    for k in range(gain.shape[1]):
        for i in range(len(gain)):
            most = 0.0
            for m in range(gain.shape[2]):
                if gain[i, k, m] > most:
                    most, chosen[i, k] = gain[i, k, m], m
            for j in range(i):
                if chosen[i, k] >= 0 and chosen[j, k] == chosen[i, k]:
                    chosen[:, k] = RIVALS
            if chosen[i, k] == RIVALS:
                break
    return chosen


@compiled()
def _predict(
    position: Array, evidence: Array, centroid: Array, area_px: float
) -> tuple[Array, Array]:
    """Return the corner positions that the most and likeliest peaks agree on, and their deviation.

    Positions are NaN where no three peaks have a say; deviations are standard deviations, pixels.
    """
    count = len(evidence)
    expected, deviation = np.full((count, NUM_CORNERS, 2), math.nan), np.empty(count)
    arms = np.empty((NUM_CORNERS, CANDIDATES, 2))
    likeliest = np.empty((NUM_CORNERS, CANDIDATES))
    # What speaks so much against a peak that no agreement makes up for it.
    hopeless = -math.log(area_px / (2 * math.pi * PREDICTION_PX**2))
    usable = np.zeros(NUM_CORNERS, np.int64)
    for i in range(count):
        for k in range(NUM_CORNERS):
            usable[k] = 0
            for m in range(evidence.shape[2]):
                value = evidence[i, k, m]
                if not value > hopeless:
                    continue
                place = usable[k]
                while place > 0 and likeliest[k, place - 1] < value:
                    place -= 1
                if place == CANDIDATES:
                    continue
                usable[k] = min(usable[k] + 1, CANDIDATES)
                for later in range(usable[k] - 1, place, -1):
                    likeliest[k, later] = likeliest[k, later - 1]
                    for axis in range(2):
                        arms[k, later, axis] = arms[k, later - 1, axis]
                likeliest[k, place] = value
                for axis in range(2):
                    arms[k, place, axis] = position[k, m, axis] - centroid[i, axis]
        deviation[i] = _best_triple(arms, likeliest, usable, area_px, expected[i])
        for k in range(NUM_CORNERS):
            for axis in range(2):
                expected[i, k, axis] += centroid[i, axis]
    return expected, deviation


@compiled()
def _best_triple(
    arms: Array, evidence: Array, usable: Array, area_px: float, expected: Array
) -> float:
    """Write the arms that the best three candidates predict; return their standard deviation."""
    best, best_variance = -math.inf, PREDICTION_PX**2
    diagonals, known = np.empty((4, 2)), np.empty(3, np.int64)
    corners, chosen = np.empty(3, np.int64), np.empty(3, np.int64)
    for number in range(4 * 8):
        missing, sides = number // 8, number % 8
        for n in range(3):
            known[n] = (missing + 1 + n) % 4
            corners[n] = DIAGONALS[known[n], sides >> n & 1]
        combinations = usable[corners[0]] * usable[corners[1]] * usable[corners[2]]
        chosen[:] = 0
        for _ in range(combinations):
            diagonals[missing] = 0.0
            for n in range(3):
                sign = -1.0 if sides >> n & 1 else 1.0
                weight = -ALTERNATING[missing] * ALTERNATING[known[n]]
                for axis in range(2):
                    arm = sign * arms[corners[n], chosen[n], axis]
                    diagonals[known[n], axis] = arm
                    diagonals[missing, axis] += weight * arm
            total, variance = _agreement(diagonals, arms, evidence, usable, area_px, best)
            if total > best:
                best, best_variance = total, variance
                for d in range(4):
                    for axis in range(2):
                        expected[DIAGONALS[d, 0], axis] = diagonals[d, axis]
                        expected[DIAGONALS[d, 1], axis] = -diagonals[d, axis]
            for n in range(3):  # the next combination, the first corner's candidates fastest
                chosen[n] += 1
                if chosen[n] < usable[corners[n]]:
                    break
                chosen[n] = 0
    return math.sqrt(best_variance)


@compiled()
def _agreement(
    diagonals: Array, arms: Array, evidence: Array, usable: Array, area_px: float, least: float
) -> tuple[float, float]:
    """Return the evidence of all candidates near these diagonals' corners, and their variance.

    The sum is given up, at whatever it is, once it cannot exceed ``least`` any more.
    """
    size = 0.0
    for d in range(4):
        size += math.sqrt(diagonals[d, 0] ** 2 + diagonals[d, 1] ** 2) / 4
    variance = PREDICTION_PX**2 + (PERSPECTIVE * size) ** 2
    gain, precision = math.log(area_px / (2 * math.pi * variance)), 0.5 / variance
    possible = 0.0
    for k in range(NUM_CORNERS):
        if usable[k]:
            possible += max(evidence[k, 0] + gain, 0.0)
    for k in range(NUM_CORNERS):
        if not possible > least:
            break
        if not usable[k]:
            continue
        most = 0.0
        d, sign = (k, 1.0) if k < 4 else ((k + 2) % 4, -1.0)
        for m in range(usable[k]):
            value = evidence[k, m] + gain
            if value <= most:
                break
            dx, dy = arms[k, m, 0] - sign * diagonals[d, 0], arms[k, m, 1] - sign * diagonals[d, 1]
            most = max(most, value - (dx * dx + dy * dy) * precision)
        possible += most - max(evidence[k, 0] + gain, 0.0)
    return possible, variance
