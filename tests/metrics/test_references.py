"""Reference rows on parts whose chances have closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.metrics.references import BEST_CONSTANT, CHANCE_ALL, CHANCE_RANGE, reference_rows
from dopepp.parts.part import Part

ABOUT_Z = np.array([0, 0, 1.0])


def dumbbell(offset=0.0):
    """Two points ±5 cm from the centre: ADD is |Qp − p|, cos of its angle uniform in [−1, 1]."""
    points = np.array([[0.05, 0, 0], [-0.05, 0, 0]]) + offset
    return Part("dumbbell", cuboid_keypoints(points.min(0), points.max(0)), 0.1, points)


def plate():
    points = np.random.default_rng(0).uniform(-1, 1, (800, 3)) * [0.0385, 0.0385, 0.0035]
    return Part("plate", cuboid_keypoints(points.min(0), points.max(0)), 0.109, points)


def poses(rotations):
    T = np.tile(np.eye(4), (len(rotations), 1, 1))
    T[:, :3, :3] = rotations.as_matrix()
    T[:, :3, 3] = [0.1, -0.1, 0.5]
    return T


@pytest.mark.parametrize("offset", [0.0, 1.0])
@pytest.mark.parametrize("reference", [CHANCE_ALL, CHANCE_RANGE])
def test_chance_over_all_rotations_has_the_closed_form(reference, offset):
    T = poses(Rotation.random(400, random_state=0))
    row = reference_rows(dumbbell(offset), T)[reference]
    # P(|Qp − p| < e) = e² / (4·r²) with r = 5 cm; four standard errors of 2,000 draws.
    for rate, share in ((row.add_01d, 0.01), (row.pass_5cm, 0.25), (row.pass_10cm, 1.0)):
        assert rate == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / 2000) + 1e-9)
    assert row.auc_10cm == pytest.approx(1 / 3, abs=0.03)  # 1 − E|Qp − p| / 10 cm, E = 4r/3
    # θ − sin θ = π/2 halves SO(3): 132.3°.
    assert row.median_rotation_deg == pytest.approx(132.3, abs=4)
    assert row.num_instances == 400
    # Without symmetries both points move alike, so MSSD is ADD.
    expected = np.mean([(share * 0.1) ** 2 / (4 * 0.05**2) for share in np.arange(1, 11) * 0.05])
    assert row.ar_mssd == pytest.approx(expected, abs=4 * 0.02)
    assert (row.ar_mspd, row.average_precision) == (None, None)


def test_a_test_set_of_one_orientation_is_solved_by_a_constant():
    T = poses(Rotation.from_rotvec(np.tile([0.3, 0.2, 0.1], (50, 1))))
    rows = reference_rows(plate(), T)
    for reference in (CHANCE_RANGE, BEST_CONSTANT):
        assert rows[reference].add_01d == 1.0
        assert rows[reference].auc_10cm == pytest.approx(1.0, abs=1e-12)
    assert rows[CHANCE_ALL].add_01d < 0.05


def test_the_best_constant_solves_one_of_two_orientations():
    angles = np.array([0.0] * 30 + [np.pi / 2] * 10)
    rows = reference_rows(plate(), poses(Rotation.from_rotvec(angles[:, None] * ABOUT_Z)))
    assert rows[BEST_CONSTANT].add_01d == 0.75
    # Of 40·39 ordered pairs, 30·29 + 10·9 have the same pose.
    assert rows[CHANCE_RANGE].add_01d == pytest.approx(960 / 1560)


def test_the_mean_orientation_is_a_candidate():
    # ADD of a turn by a about z is 2·sin(a/2)·mean radius (2.9 cm): ±20° is right from 0° only.
    angles = np.radians([-20.0] * 5 + [20.0] * 5)
    rows = reference_rows(plate(), poses(Rotation.from_rotvec(angles[:, None] * ABOUT_Z)))
    assert rows[BEST_CONSTANT].add_01d == 1.0
    assert rows[BEST_CONSTANT].median_rotation_deg == pytest.approx(20)


def test_rows_depend_on_the_seed_only():
    T = poses(Rotation.random(60, random_state=1))
    rows = reference_rows(plate(), T, seed=3)
    assert rows == reference_rows(plate(), T[::-1], seed=3)
    assert rows != reference_rows(plate(), T, seed=4)
    for row in rows.values():  # a guess has no score and no position
        assert row.median_translation is None
        assert (row.miss_rate, row.precision, row.false_per_frame) == (None, None, None)


def test_without_instances_and_with_a_single_one():
    for row in reference_rows(plate(), np.empty((0, 4, 4))).values():
        assert (row.num_instances, row.add_01d) == (0, None)
    rows = reference_rows(plate(), poses(Rotation.random(1, random_state=0)))
    assert rows[CHANCE_RANGE].add_01d is None
    assert (rows[CHANCE_RANGE].num_instances, rows[BEST_CONSTANT].add_01d) == (1, 1.0)


def test_symmetries_do_not_depend_on_the_origin():
    """A half turn about the dumbbell's centre, which is far from the origin."""
    centre = np.array([1.0, 1.0, 1.0])
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    half_turn[:3, 3] = centre - half_turn[:3, :3] @ centre
    part = replace(dumbbell(1.0), symmetries_discrete=half_turn[None])
    T = poses(Rotation.from_rotvec([[0, 0, 0], np.pi * ABOUT_Z]))
    row = reference_rows(part, T)[CHANCE_RANGE]
    rates = (row.add_01d, row.add_s_01d, row.mssd_01d, row.ar_mssd)
    assert rates == (0.0, 1.0, 1.0, 1.0)
    assert row.median_rotation_deg == pytest.approx(180)
    assert row.median_rotation_s_deg == pytest.approx(0, abs=1e-6)
    assert row.num_symmetries == 2
