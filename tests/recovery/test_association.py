import math
from itertools import combinations, product

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dopepp.geometry.camera import project_keypoints, transform
from dopepp.geometry.cuboid import CORNER_SIGNS
from dopepp.recovery.association import (
    PERSPECTIVE,
    PREDICTION_PX,
    KeypointGroup,
    ObjectPeaks,
    _predict,
    associate,
    direction_evidence,
    solve_group,
)

WIDE = math.radians(45)


def peaks(corners, toward, centroids, score=1.0):
    """Return peaks at known positions, (8, n, 2); NaN for missing peaks."""
    centroid = np.array(centroids, float).reshape(-1, 2)
    is_present = np.isfinite(corners[..., 0])
    scores, spread = np.where(is_present, score, 0.0), np.eye(2)
    spreads = [np.tile(spread, (*shape, 1, 1)) for shape in (corners.shape[:2], (len(centroid),))]
    ones = np.ones(len(centroid))
    return ObjectPeaks(corners, scores, spreads[0], toward, centroid, ones, spreads[1], 160_000.0)


def one_corner(position, toward, centroids, score=1.0):
    corners, vectors = np.full((2, 8, len(np.array(position)), 2), np.nan)
    corners[0], vectors[0] = position, toward
    return peaks(corners, vectors, centroids, score)


def group(peaks, max_angle=WIDE, coincident_px=8.0):
    return associate(peaks, direction_evidence(peaks, max_angle, coincident_px))


def crowd(rng, count):
    """Return affine projections of cuboids: corners (8, n, 2) and centroids (n, 2)."""
    centroids = rng.uniform(0, 400, (count, 2))
    affine = rng.normal(scale=25, size=(count, 2, 3))
    return centroids[None] + np.einsum("nij,kj->kni", affine, CORNER_SIGNS), centroids


def test_corner_joins_the_centroid_its_vector_points_to():
    left, right = group(one_corner([[40, 0], [60, 0]], [[1, 0], [-1, 0]], [[0, 0], [100, 0]]))
    assert_array_equal(left.position[0], [60, 0])
    assert_array_equal(right.position[0], [40, 0])
    assert np.isnan(left.position[1:8]).all()
    assert_array_equal(left.score, [1, 0, 0, 0, 0, 0, 0, 0, 1])


@pytest.mark.parametrize("vector", [[0, 1], [1, 0], [np.nan, 0], [np.inf, 0]])
def test_corner_with_another_direction_is_not_assigned(vector):
    (alone,) = group(one_corner([[40, 0]], [vector], [[0, 0]]))
    assert np.isnan(alone.position[0]).all()


def test_stronger_of_two_peaks_is_assigned():
    score = np.array([0.5, 0.9])
    (item,) = group(one_corner([[40, 0], [0, 50]], [[-1, 0], [0, -1]], [[0, 0]], score))
    assert_array_equal(item.position[0], [0, 50])


def test_a_corner_on_the_centroid_needs_no_direction():
    result = one_corner([[3, 0]], [[1, 0]], [[0, 0]])
    assert direction_evidence(result, WIDE, 8.0)[0, 0, 0] == 0
    assert direction_evidence(result, WIDE, 2.0)[0, 0, 0] == -np.inf


def test_affine_camera_separates_corners_in_one_direction():
    """Vectors have a direction only; the affine camera predicts the length."""
    rng = np.random.default_rng(0)
    right = total = 0
    for _ in range(30):
        corners, centroids = crowd(rng, 6)
        toward = centroids[None] - corners
        toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
        toward += 0.05 * rng.normal(size=toward.shape)
        order = rng.permuted(np.tile(np.arange(6), (8, 1)), axis=1)[..., None]
        shuffled = (np.take_along_axis(values, order, 1) for values in (corners, toward))
        result = peaks(*shuffled, centroids)
        for n, first in enumerate(group(result)):
            right += (first.position[:8] == corners[:, n]).all(1).sum()
            total += 8
    assert right >= 0.97 * total


def test_the_triple_with_the_most_evidence_predicts_the_corners():
    """Compare with all triples without opposite corners, as weighted sums of their arms."""
    rng = np.random.default_rng(3)
    for _ in range(3):
        corners, centroids = crowd(rng, 3)
        corners = corners + rng.normal(0, 3, corners.shape)
        toward = 0.05 * rng.normal(size=corners.shape)  # so short that all may belong together
        result = peaks(corners, toward, centroids)
        evidence = direction_evidence(result, math.pi, 8.0)
        expected, deviation = _predict(result, evidence)
        for i, centroid in enumerate(centroids):
            best = -np.inf
            for triple in combinations(range(8), 3):
                signs = CORNER_SIGNS[list(triple)]
                if abs(np.linalg.det(signs)) < 1:
                    continue
                weights = np.linalg.solve(signs.T, CORNER_SIGNS.T).T
                for chosen in product(range(corners.shape[1]), repeat=3):
                    arms = corners[list(triple), list(chosen)] - centroid
                    predicted = weights @ arms
                    size = np.linalg.norm(predicted, axis=1).mean()
                    variance = PREDICTION_PX**2 + (PERSPECTIVE * size) ** 2
                    squared = ((corners - centroid - predicted[:, None]) ** 2).sum(-1)
                    gain = np.log(result.area_px / (2 * np.pi * variance)) - squared / 2 / variance
                    total = np.maximum(evidence[i] + gain, 0).max(1).sum()
                    if total > best + 1e-9:
                        best, answer = total, (predicted + centroid, np.sqrt(variance))
            assert_allclose(expected[i], answer[0], atol=1e-9)
            assert_allclose(deviation[i], answer[1])


def test_expected_corner_of_a_pose_decides():
    result = one_corner([[40, 0], [60, 0]], [[-1, 0], [-1, 0]], [[0, 0]])
    expected = np.full((1, 8, 2), np.nan)
    expected[0, 0] = 61, 1
    evidence = direction_evidence(result, WIDE, 8.0)
    assert_array_equal(associate(result, evidence, expected)[0].position[0], [60, 0])


def test_no_instance_without_a_centroid():
    assert group(one_corner([[1, 1]], [[1, 0]], np.zeros((0, 2)))) == []


def error(T, truth, cuboid):
    if T is None:
        return np.inf
    return float(np.linalg.norm(transform(T, cuboid) - transform(truth, cuboid), axis=1).mean())


def test_wide_peaks_have_less_weight(box, K, pose):
    """Compare poses from noisy pixels with their true and with equal covariances."""
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(40):
        truth = pose(rng)
        noise = np.array([0.3] * 5 + [6.0] * 4)
        pixels = project_keypoints(box, truth, K) + rng.normal(size=(9, 2)) * noise[:, None]
        honest = noise[:, None, None] ** 2 * np.eye(2)
        equal = np.tile(9.0 * np.eye(2), (9, 1, 1))
        groups = (KeypointGroup(pixels, np.ones(9), spread) for spread in (honest, equal))
        errors.append([error(solve_group(group, box, K).T_cam_obj, truth, box) for group in groups])
    true_error, equal_error = np.median(errors, axis=0)
    assert true_error < 0.5 * equal_error


def test_peaks_narrower_than_their_errors_yield_poses(box, K, pose):
    rng = np.random.default_rng(1)
    good = 0
    for _ in range(40):
        truth = pose(rng)
        pixels = project_keypoints(box, truth, K) + 2.0 * rng.normal(size=(9, 2))
        group = KeypointGroup(pixels, np.ones(9), np.zeros((9, 2, 2)))
        result = solve_group(group, box, K)
        good += error(result.T_cam_obj, truth, box) < 0.0141  # a tenth of the diameter
        assert result.T_cam_obj is None or result.inliers.sum() >= 4
    assert good >= 38
