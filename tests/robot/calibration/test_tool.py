import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import make_transform, transform
from dopepp.robot.calibration.board import parse_board
from dopepp.robot.calibration.tool import bench_of_board, find_bench, find_tip

TIP, PIVOT = np.array([0.01, -0.02, 0.15]), np.array([0.4, 0.1, 0.05])


def touching(rotations, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    shifts = PIVOT - rotations.apply(TIP) + noise * rng.normal(size=(len(rotations), 3))
    pairs = zip(rotations.as_matrix(), shifts, strict=True)
    return np.array([make_transform(*pair) for pair in pairs])


@given(st.integers(0, 10**6), st.integers(4, 20))
def test_the_tip_is_exact_without_noise(seed, num):
    tip = find_tip(touching(Rotation.random(num, rng=np.random.default_rng(seed))))
    assert np.allclose(tip.position, TIP, atol=1e-9)


def test_the_error_of_the_tip_fits_its_deviations():
    squares = []
    for seed in range(40):
        tilts = Rotation.from_euler("xyz", np.random.default_rng(seed).uniform(-0.7, 0.7, (8, 3)))
        tip = find_tip(touching(tilts, 2e-4, seed))
        assert np.linalg.norm(tip.position - TIP) < 0.001
        assert not tip.findings
        squares.append(((tip.position - TIP) / tip.deviations) ** 2)
    assert 0.6 < np.mean(squares) < 1.7


def test_rotations_about_one_axis_do_not_determine_the_tip():
    tip = find_tip(touching(Rotation.from_rotvec(np.outer(np.linspace(0, 2, 6), [0, 0, 1])), 1e-4))
    assert "z axis" in tip.findings[0]
    assert tip.deviations[2] > 1.0  # metres


def test_a_touch_beside_the_point_is_a_finding():
    tilts = Rotation.from_euler("xyz", np.random.default_rng(1).uniform(-0.7, 0.7, (9, 3)))
    poses = touching(tilts)
    poses[4, :3, 3] += [0.01, 0, 0]
    assert any("pose 5" in finding for finding in find_tip(poses).findings)


def test_three_touches_are_rejected():
    with pytest.raises(UserError, match="at least 4"):
        find_tip(touching(Rotation.random(3, rng=np.random.default_rng(0))))


def test_a_bench_is_estimated_with_its_frame():
    rng = np.random.default_rng(0)
    R = Rotation.from_euler("xyz", [3, -4, 60], degrees=True).as_matrix()
    T = make_transform(R, [0.5, 0.1, -0.02])
    local = np.array([[0, 0, 0], [0.3, 0, 0], [0.1, 0.2, 0], [0.3, 0.3, 0], [-0.1, 0.2, 0]])
    result = find_bench(transform(T, local) + 1e-4 * rng.normal(size=local.shape))
    assert np.allclose(result.T_base_bench[:3, :3], T[:3, :3], atol=2e-3)
    assert np.allclose(result.T_base_bench[:3, 3], T[:3, 3], atol=3e-4)
    assert not result.findings
    assert np.linalg.det(result.T_base_bench[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((2, 3)), "at least 3"),
        (np.outer(np.arange(4), [1.0, 2, 0]), "along a line"),
        (np.eye(3)[[0, 0, 1, 2]], "next to the first"),
    ],
)
def test_points_that_determine_no_plane_are_rejected(points, message):
    with pytest.raises(UserError, match=message):
        find_bench(points)


def test_a_point_off_the_plane_is_a_finding():
    points = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0], [0.3, 0.3, 0], [0.15, 0.15, 0.02]])
    assert any("point 5" in finding for finding in find_bench(points).findings)


def test_a_bench_is_estimated_from_a_board():
    board, rng = parse_board("charuco:8x6:25:19"), np.random.default_rng(0)
    T = make_transform(Rotation.from_euler("xyz", [184, 3, 40], degrees=True).as_matrix(), PIVOT)
    poses = [make_transform(T[:3, :3], T[:3, 3] + 2e-4 * rng.normal(size=3)) for _ in range(5)]
    result = bench_of_board(poses, board)
    assert not result.findings
    # The z axis of the board points into the bench.
    flipped = make_transform(T[:3, :3] @ np.diag([1.0, -1, -1]), T[:3, 3])
    assert np.allclose(result.T_base_bench, flipped, atol=5e-4)
    assert np.abs(result.residuals).max() < 1e-3
    poses[3] = make_transform(T[:3, :3], T[:3, 3] + [0, 0, 0.01])
    assert any("image 4" in finding for finding in bench_of_board(poses, board).findings)
    assert "cannot be verified" in bench_of_board(poses[:1], board).findings[0]
