"""Group the peaks of one object into instances and solve the pose of each instance.

:func:`select_peaks` selects an object's peaks on one image. :func:`solve_instances` then alternates
:func:`associate`, which assigns corner peaks to centroids, and PnP, until the poses no longer
change a group.

In the first round, without poses, an affine camera predicts the corners: seen from far enough away,
a corner with signs s lies at c + A s, where c is the centroid and A a 2×3 matrix. Opposite corners
have opposite vectors A s ("arms"), and the arms of three diagonals give the fourth. So any three
corners, no two of them opposite, predict the other five.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import scipy  # SciPy loads its submodules on first use
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, project_keypoints
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS, Cuboid
from dopepp.geometry.pnp import PnPResult, solve_pnp
from dopepp.geometry.refine import MIN_POINTS, too_few
from dopepp.maps.codec import Peaks

Evidence = Float[np.ndarray, "instances 8 peaks"]  # log-likelihood ratios
CornerPeaks = Float[np.ndarray, "8 peaks 2"]
Corners = Float[np.ndarray, "instances 8 2"]

MIN_DEVIATION: Final = 0.05  # smallest standard deviation of a vector's direction, radians
POSITION_PX: Final = 1.0  # standard deviation of positions, for directions to near centroids
MIN_LENGTH: Final = 1e-3  # a shorter mean vector has no direction
PREDICTION_PX: Final = 4.0  # deviation of a keypoint from its prediction: half a cell of stride 8
CANDIDATES: Final = 3  # number of peaks per corner, by belief and direction, that form triples

PERSPECTIVE: Final = 0.1
"""Deviation of corners from the affine camera, in distances from the centroid: at a distance of
five times the part's size, corners are up to 10 % nearer or farther than the centroid."""

SIGMA_FLOOR_PX: Final = 1.0  # bounds the weight of a sharp peak against a blurred peak
WIDENINGS: Final = (1.0, 2.0, 4.0)  # factors on the standard deviations of peaks, tried in turn
ROUNDS: Final = 3  # maximum number of times that poses regroup the keypoints

BORDER: Final = 1.0  # distance from the maps' border, cells, at which a keypoint may lie outside
BORDER_DEVIATION: Final = 0.75
"""RMS error of a peak at the border for trained networks, cells: half of the belief lies outside
the maps, which shifts the peak inward."""

DIAGONALS: Final = np.array([(0, 6), (1, 7), (2, 4), (3, 5)])  # Opposite corners
ALTERNATING: Final = np.array([1.0, -1.0, 1.0, -1.0])
"""Weights with which the arms of the diagonals' first corners sum to 0."""
RIVALS: Final = -2  # marks a corner for which two instances prefer the same peak


class ObjectPeaks(NamedTuple):
    """The peaks of one object's corners and centroids on one image, input pixels."""

    position: CornerPeaks  # (x, y) of peaks of corners 0–7; NaN in slots without a peak
    score: Float[np.ndarray, "8 peaks"]  # belief at the peak; 0 in slots without a peak
    covariance_px: Float[np.ndarray, "8 peaks 2 2"]  # covariance of the position
    # Mean vector of the field at the peak, pointing to the centroid. The shorter it is, the less
    # certain is its direction.
    toward: CornerPeaks
    centroid: Float[np.ndarray, "instances 2"]  # (x, y) of the centroid peaks, one per instance
    centroid_score: Float[np.ndarray, "instances"]  # belief at each centroid peak
    centroid_covariance_px: Float[np.ndarray, "instances 2 2"]
    area_px: float  # area of the network's input


class KeypointGroup(NamedTuple):
    """An instance's corners and centroid, input pixels; NaN and a score of 0 without a peak."""

    position: Float[np.ndarray, "9 2"]
    score: Float[np.ndarray, "9"]
    covariance_px: Float[np.ndarray, "9 2 2"]


def select_peaks(
    peaks: Peaks, image: int, number: int, threshold: float, cells: tuple[int, int], stride: float
) -> ObjectPeaks:
    """Return the peaks of one object on one image, with wider covariances at the border.

    Args:
        peaks: Peaks of all channels of a batch.
        image: Index of the image in the batch.
        number: Index of the object.
        threshold: Smallest belief of a centroid peak that counts as an instance.
        cells: (width, height) of the maps, cells.
        stride: Input pixels per cell.
    """
    first = number * NUM_KEYPOINTS
    corners, centroid = (image, slice(first, first + NUM_CORNERS)), (image, first + CENTROID)
    strong = peaks.score[centroid] >= threshold
    extent = np.array(cells) * float(stride)
    position = peaks.position[corners]
    return ObjectPeaks(
        position,
        peaks.score[corners],
        _border_covariance(position, peaks.covariance_px[corners], extent, float(stride)),
        peaks.toward[corners],
        peaks.position[centroid][strong],
        peaks.score[centroid][strong],
        peaks.covariance_px[centroid][strong],
        float(extent.prod()),
    )


def solve_instances(
    peaks: ObjectPeaks, cuboid: Cuboid, K: CameraMatrix, max_angle: float, coincident_px: float
) -> list[tuple[KeypointGroup, PnPResult]]:
    """Group peaks into instances by :func:`direction_evidence` and solve their poses by PnP.

    Args:
        peaks: Corner peaks and centroids of the object on one image.
        cuboid: Keypoints of the object, object frame, metres.
        K: Camera matrix of the network's input, pixels.
        max_angle: See :func:`direction_evidence`.
        coincident_px: See :func:`direction_evidence`.

    Returns:
        Keypoints and PnP result of each centroid; the result has no pose if PnP failed.
    """
    if not len(peaks.centroid):
        return []
    evidence = direction_evidence(peaks, max_angle, coincident_px)
    groups = associate(peaks, evidence)
    results = [solve_group(group, cuboid, K) for group in groups]
    for _ in range(ROUNDS):
        if all(result.inliers.all() for result in results):
            break  # all keypoints agree, so regrouping cannot improve a pose
        expected = np.full((len(groups), NUM_CORNERS, 2), np.nan)
        for corners, result in zip(expected, results, strict=True):
            if result.T_cam_obj is not None:
                corners[:] = project_keypoints(cuboid, result.T_cam_obj, K)[:NUM_CORNERS]
        previous, groups = groups, associate(peaks, evidence, expected)
        changed = False
        for number, (old, new) in enumerate(zip(previous, groups, strict=True)):
            if old.position.tobytes() != new.position.tobytes():
                results[number], changed = solve_group(new, cuboid, K), True
        if not changed:
            break
    return list(zip(groups, results, strict=True))


def solve_group(group: KeypointGroup, cuboid: Cuboid, K: CameraMatrix) -> PnPResult:
    """Solve PnP with keypoints weighted by their inverse covariances.

    Covariances are averaged over directions: the width of a network's peak predicts the size of its
    error, its shape does not predict the direction. Peaks are narrower than a network's errors, so
    deviations are multiplied by :data:`WIDENINGS` until two thirds of the keypoints fit a pose.
    """
    count = sum(math.isfinite(x) for x in group.position[:, 0].tolist())
    if count < MIN_POINTS:  # noise produces many groups with too few keypoints
        return PnPResult(None, math.inf, np.zeros(NUM_KEYPOINTS, bool), too_few(count))
    covariance = _averaged(group.covariance_px)
    return solve_pnp(cuboid, group.position, K, covariance_px=covariance, widenings=WIDENINGS)


def associate(
    peaks: ObjectPeaks, evidence: Evidence, expected: Corners | None = None
) -> list[KeypointGroup]:
    """Group peaks into instances, one per centroid.

    For each corner, peaks are assigned to centroids one-to-one so that the sum of log-likelihood
    ratios is greatest: of belief and direction, and of the distance to the expected position. A
    peak without a positive ratio is not assigned.

    Args:
        peaks: Corner peaks and centroids.
        evidence: Result of :func:`direction_evidence`.
        expected: Corners projected with the instances' poses, pixels, NaN for an instance without a
            pose (default: predicted from triples of corners).
    """
    deviation = np.full(len(evidence), PREDICTION_PX)
    if expected is None:
        expected, deviation = _predict(peaks, evidence)
    gain = _gain(evidence, peaks, expected, deviation)
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


def _border_covariance(position: Array, covariance: Array, extent: Array, stride: float) -> Array:
    """Return covariances, pixels², with ``BORDER_DEVIATION``² added within ``BORDER`` cells."""
    inward = np.minimum(position + 0.5, extent - 0.5 - position).min(axis=-1)
    widened = covariance.copy()
    widened[inward < BORDER * stride] += (BORDER_DEVIATION * stride) ** 2 * np.eye(2)
    return widened


@compiled()
def _averaged(covariance: Array) -> Array:
    """Return isotropic covariances of the mean variance plus ``SIGMA_FLOOR_PX``²; NaN stays NaN."""
    averaged = np.zeros(covariance.shape)
    for k in range(len(covariance)):
        variance = (covariance[k, 0, 0] + covariance[k, 1, 1]) / 2 + SIGMA_FLOOR_PX**2
        averaged[k, 0, 0] = averaged[k, 1, 1] = variance
    return averaged


@compiled()
def direction_evidence(peaks: ObjectPeaks, max_angle: float, coincident_px: float) -> Evidence:
    """Return log-likelihood ratios that each corner peak belongs to each instance.

    A ratio is the product of both beliefs and the density of the angle between the field's vector
    at the corner and the direction to the centroid, over a uniform density. A vector without
    direction is neutral. Unit vectors whose angles deviate by σ have a mean of length exp(−σ²/2).

    Args:
        peaks: Corner peaks and centroids.
        max_angle: Largest allowed angle, radians; for larger angles, the result is −∞.
        coincident_px: Distance from a centroid within which any angle is allowed.
    """
    position, score, toward, centroid = peaks.position, peaks.score, peaks.toward, peaks.centroid
    evidence = np.full((len(centroid), *score.shape), -math.inf)
    beliefs = np.log(peaks.centroid_score)
    for k, m in np.ndindex(score.shape):
        if not score[k, m] > 0.0:
            continue
        belief = math.log(score[k, m])
        u, v = toward[k, m, 0], toward[k, m, 1]
        length = math.sqrt(u * u + v * v)
        # A vector that is not finite, as from a diverged network, has no direction.
        directed = MIN_LENGTH <= length < math.inf
        spread = MIN_DEVIATION**2 - 2 * math.log(min(length, 1.0) if directed else MIN_LENGTH)
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
def _gain(evidence: Array, peaks: ObjectPeaks, expected: Array, deviation: Array) -> Array:
    """Return ``evidence`` plus the evidence of the peaks' positions; negative sums become 0.

    The evidence of a position is the logarithm of a ratio: a Gaussian density around the expected
    position (``deviation``: its standard deviation for each instance, pixels) over the density of a
    peak anywhere on the maps. Without an expected position, this evidence is 0.
    """
    position, covariance_px, area_px = peaks.position, peaks.covariance_px, peaks.area_px
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
    """Return each instance's best peak per corner, or −1 (no peak), or ``RIVALS`` (shared peak)."""
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
def _predict(peaks: ObjectPeaks, evidence: Array) -> tuple[Array, Array]:
    """Predict the corners of each instance from three of its corner peaks by :func:`_best_triple`.

    Returns:
        (x, y) of the corners, NaN for an instance without three usable corners, and their standard
        deviation for each instance, pixels.
    """
    position, centroid, area_px = peaks.position, peaks.centroid, peaks.area_px
    count = len(evidence)
    expected, deviation = np.full((count, NUM_CORNERS, 2), math.nan), np.empty(count)
    arms = np.empty((NUM_CORNERS, CANDIDATES, 2))
    likeliest = np.empty((NUM_CORNERS, CANDIDATES))
    # Even perfect agreement of the position does not outweigh evidence below this limit.
    hopeless = -math.log(area_px / (2 * math.pi * PREDICTION_PX**2))
    usable = np.zeros(NUM_CORNERS, np.int64)
    for i in range(count):
        for k in range(NUM_CORNERS):
            usable[k] = 0
            for m in range(evidence.shape[2]):
                value = evidence[i, k, m]
                if not value > hopeless:
                    continue
                rank = usable[k]
                while rank > 0 and likeliest[k, rank - 1] < value:
                    rank -= 1
                if rank == CANDIDATES:
                    continue
                usable[k] = min(usable[k] + 1, CANDIDATES)
                for later in range(usable[k] - 1, rank, -1):
                    likeliest[k, later] = likeliest[k, later - 1]
                    for axis in range(2):
                        arms[k, later, axis] = arms[k, later - 1, axis]
                likeliest[k, rank] = value
                for axis in range(2):
                    arms[k, rank, axis] = position[k, m, axis] - centroid[i, axis]
        deviation[i] = _best_triple(arms, likeliest, usable, area_px, expected[i])
        for k in range(NUM_CORNERS):
            for axis in range(2):
                expected[i, k, axis] += centroid[i, axis]
    return expected, deviation


@compiled()
def _best_triple(
    arms: Array, evidence: Array, usable: Array, area_px: float, expected: Array
) -> float:
    """Predict an instance's corners from three peaks with the highest :func:`_agreement`.

    The ``usable[k]`` candidates of corner k have the vectors ``arms[k]`` from the centroid, pixels.
    ``expected`` is filled with the predicted vectors, and their standard deviation is returned.
    """
    best, best_variance = -math.inf, PREDICTION_PX**2
    diagonals, given = np.empty((4, 2)), np.empty(3, np.int64)
    corners, chosen = np.empty(3, np.int64), np.empty(3, np.int64)
    for number in range(4 * 8):
        missing, sides = number // 8, number % 8
        for n in range(3):
            given[n] = (missing + 1 + n) % 4
            corners[n] = DIAGONALS[given[n], sides >> n & 1]
        combinations = usable[corners[0]] * usable[corners[1]] * usable[corners[2]]
        chosen[:] = 0
        for _ in range(combinations):
            diagonals[missing] = 0.0
            for n in range(3):
                sign = -1.0 if sides >> n & 1 else 1.0
                weight = -ALTERNATING[missing] * ALTERNATING[given[n]]
                for axis in range(2):
                    arm = sign * arms[corners[n], chosen[n], axis]
                    diagonals[given[n], axis] = arm
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
    """Sum over corners the highest evidence that a candidate is the corner that diagonals predict.

    ``diagonals`` has the vectors from the centroid to corners 0–3, pixels. The summation stops
    early, with an upper bound, once the sum cannot exceed ``least``.

    Returns:
        The sum, and the variance of the predicted positions, pixels².
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
