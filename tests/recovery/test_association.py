from __future__ import annotations

import math
from itertools import permutations

import numpy as np
from numpy.testing import assert_array_equal

from dopepp.recovery.association import ChannelPeaks, associate

NONE = ChannelPeaks(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2)))


def peaks(position: object, toward: object = None, score: object = None) -> ChannelPeaks:
    where = np.array(position, float).reshape(-1, 2)
    vectors = np.zeros_like(where) if toward is None else np.array(toward, float).reshape(-1, 2)
    scores = np.ones(len(where)) if score is None else np.array(score, float)
    return ChannelPeaks(where, scores, np.full_like(where, 8.0), vectors)


def test_a_corner_goes_where_its_vector_points() -> None:
    centroids = peaks([[0, 0], [100, 0]])
    corner = peaks([[40, 0], [60, 0]], [[1, 0], [-1, 0]])
    left, right = associate([corner, *[NONE] * 7, centroids], math.radians(45), 8)
    assert_array_equal(left.position[0], [60, 0])
    assert_array_equal(right.position[0], [40, 0])
    assert np.isnan(left.position[1:8]).all()
    assert_array_equal(left.score, [1, 0, 0, 0, 0, 0, 0, 0, 1])


def test_the_assignment_is_the_best_of_all() -> None:
    """Against trying every one-to-one pairing, angles and scores at random."""
    rng = np.random.default_rng(0)
    limit = math.radians(170)
    for _ in range(50):
        centroids = peaks(rng.uniform(0, 400, (3, 2)))
        turn = rng.uniform(0, 2 * np.pi, 3)
        vectors = np.stack([np.cos(turn), np.sin(turn)], 1)
        corner = peaks(rng.uniform(0, 400, (3, 2)), vectors, rng.uniform(0.05, 1, 3))
        offset = centroids.position[None] - corner.position[:, None]
        cosine = (offset * vectors[:, None]).sum(-1) / np.linalg.norm(offset, axis=-1)
        angle = np.arccos(np.clip(cosine, -1, 1))
        if (angle > limit).any():
            continue
        best = min(permutations(range(3)), key=lambda p: sum(angle[p[j], j] ** 2 for j in range(3)))
        groups = associate([corner, *[NONE] * 7, centroids], limit, 1e-6)
        for j, group in enumerate(groups):
            assert_array_equal(group.position[0], corner.position[best[j]])


def test_a_vector_that_points_elsewhere_joins_nobody() -> None:
    corner = peaks([[40, 0]], [[0, 1]])
    (group,) = associate([corner, *[NONE] * 7, peaks([[0, 0]])], math.radians(45), 8)
    assert np.isnan(group.position[0]).all()


def test_the_stronger_of_two_peaks_wins() -> None:
    corner = peaks([[40, 0], [0, 50]], [[-1, 0], [0, -1]], [0.1, 0.9])
    (group,) = associate([corner, *[NONE] * 7, peaks([[0, 0]])], math.radians(45), 8)
    assert_array_equal(group.position[0], [0, 50])


def test_a_corner_on_the_centroid_needs_no_direction() -> None:
    corner = peaks([[3, 0]], [[1, 0]])
    (group,) = associate([corner, *[NONE] * 7, peaks([[0, 0]])], math.radians(45), 8)
    assert_array_equal(group.position[0], [3, 0])


def test_a_vector_that_is_no_number_joins_nobody() -> None:
    corner = peaks([[40, 0], [-40, 0]], [[np.nan, 0], [1, 0]])
    groups = associate([corner, *[NONE] * 7, peaks([[0, 0], [9, 9]])], math.radians(45), 2)
    assert_array_equal(groups[0].position[0], [-40, 0])
    assert np.isnan(groups[1].position[0]).all()


def test_no_centroid_no_instance() -> None:
    assert associate([peaks([[1, 1]], [[1, 0]])] * 8 + [NONE], 1.0, 8) == []
