import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from dopepp.geometry.camera import (
    camera_matrix,
    make_transform,
    project,
    project_keypoints,
    transform,
)
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.pnp import MAX_DISTANCE, solve_pnp
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

K = camera_matrix(600, 610, 207.5, 201.25)


def box(x, y, z, centre=(0, 0, 0)):
    half = np.array([x, y, z]) / 2
    return cuboid_keypoints(np.array(centre) - half, np.array(centre) + half)


CUBOIDS = {
    "box": box(0.08, 0.06, 0.1),
    "can": box(0.07, 0.07, 0.1),
    "plate": box(0.105, 0.052, 0.007),
    "plate across x": box(0.007, 0.105, 0.052),
    "box off its origin": box(0.06, 0.16, 0.21, (0.3, -0.5, 0.2)),
}


def look_at(cuboid, rng):
    """Return a random pose, with the cuboid's centre in view at 2.5 to 5 times its size."""
    rotation = random_rotation(rng)
    size = float(np.linalg.norm(cuboid[0] - cuboid[6]))
    centre = size * rng.uniform([-0.5, -0.5, 2.5], [0.5, 0.5, 5.0])
    return make_transform(rotation, centre - rotation @ cuboid[8])


def add(T, truth, cuboid):
    """Return the mean corner distance in diameters; infinite without a pose."""
    if T is None:
        return np.inf
    error = np.linalg.norm(transform(T, cuboid) - transform(truth, cuboid), axis=1).mean()
    return float(error / np.linalg.norm(cuboid[0] - cuboid[6]))


def isotropic(sigma):
    """Covariances of standard deviations in pixels."""
    with np.errstate(all="ignore"):
        return np.asarray(sigma)[..., None, None] ** 2 * np.eye(2)


def check(result, object_points):
    """Check what holds for the result of any input."""
    assert (result.inliers.shape, result.inliers.dtype) == ((len(object_points),), bool)
    assert (result.T_cam_obj is None) == bool(result.reason)
    if result.T_cam_obj is None:
        assert (result.reprojection_error_px, result.inliers.sum()) == (np.inf, 0)
        return
    T = result.T_cam_obj
    assert np.isfinite([*T.flat, result.reprojection_error_px]).all()
    assert result.inliers.sum() >= 4
    assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(T[:3, :3]) > 0
    assert_array_equal(T[3], [0, 0, 0, 1])
    inliers = object_points[result.inliers]
    size = np.linalg.norm(np.ptp(object_points[np.isfinite(object_points).all(1)], axis=0))
    assert transform(T, inliers)[:, 2].min() > 0
    # MAX_DISTANCE limits the centre of the inliers; a point is at most one size farther.
    assert np.linalg.norm(transform(T, inliers), axis=1).max() <= (MAX_DISTANCE + 1) * size * 1.001


@pytest.mark.parametrize("cuboid", CUBOIDS.values(), ids=CUBOIDS)
@given(seed=st.integers(0, 2**32 - 1))
def test_clean_points_give_the_exact_pose(cuboid, seed):
    truth = look_at(cuboid, np.random.default_rng(seed))
    result = solve_pnp(cuboid, project_keypoints(cuboid, truth, K), K)
    check(result, cuboid)
    assert result.inliers.all()
    assert result.reprojection_error_px < 1e-3
    assert add(result.T_cam_obj, truth, cuboid) < 1e-3


@pytest.mark.parametrize("count", [4, 5, 6, 8])
def test_some_points_are_enough(count):
    rng, cuboid = np.random.default_rng(count), CUBOIDS["box"]
    good = 0
    for _ in range(30):
        truth = look_at(cuboid, rng)
        pixels = project_keypoints(cuboid, truth, K)
        missing = rng.permutation(9)[count:]
        pixels[missing] = np.nan
        result = solve_pnp(cuboid, pixels, K)
        check(result, cuboid)
        assert not result.inliers[missing].any()
        good += add(result.T_cam_obj, truth, cuboid) < 1e-3
    # Four points may lie in a plane or have several solutions.
    assert good >= (20 if count == 4 else 29)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e4])
@pytest.mark.parametrize("camera", [K, np.array([[600, 40.0, 1500], [0, 500, -900], [0, 0, 1]])])
def test_any_unit_of_length_and_skew(size, camera):
    rng, cuboid = np.random.default_rng(0), size * CUBOIDS["plate"]
    truth = look_at(cuboid, rng)
    result = solve_pnp(cuboid, project_keypoints(cuboid, truth, camera), camera)
    assert add(result.T_cam_obj, truth, cuboid) < 1e-3


@pytest.mark.parametrize(("name", "count"), [*((name, 1) for name in CUBOIDS), ("box", 2)])
def test_wild_corners_are_rejected(name, count):
    cuboid, rng = CUBOIDS[name], np.random.default_rng(1)
    good, trials = 0, 20 * count
    for _ in range(trials):
        truth = look_at(cuboid, rng)
        pixels = project_keypoints(cuboid, truth, K) + rng.normal(size=(9, 2)) * 0.2
        wild = rng.integers(8, size=count)
        pixels[wild] += 60 * np.stack([np.cos(wild), np.sin(wild)], axis=1)
        result = solve_pnp(cuboid, pixels, K, isotropic(0.2))
        check(result, cuboid)
        near = add(result.T_cam_obj, truth, cuboid) < 0.1
        is_clean = not result.inliers[wild].any() and result.inliers.sum() >= 8 - count
        good += near and is_clean and result.reprojection_error_px < 0.6
    assert good >= (20 if count == 1 else 38)


@pytest.mark.parametrize(
    "bad",
    [
        *(np.zeros((2, 2)), -np.eye(2), np.full((2, 2), np.nan), np.diag([np.inf, 1])),
        np.array([[1.0, 2.0], [2.0, 1.0]]),
    ],
    ids=str,
)
def test_a_point_without_a_proper_covariance_is_missing(bad):
    cuboid = CUBOIDS["box"]
    pixels = project_keypoints(cuboid, look_at(cuboid, np.random.default_rng(3)), K)
    pixels[2] += 100
    assert "0 usable points" in solve_pnp(cuboid, pixels, K, bad).reason
    covariance = np.tile(np.eye(2), (9, 1, 1))
    covariance[2] = bad
    result = solve_pnp(cuboid, pixels, K, covariance)
    assert_array_equal(result.inliers, np.arange(9) != 2)


def opencv(cuboid, pixels, flag):
    result, vector, translation = cv2.solvePnP(cuboid, pixels, K, None, flags=flag)
    turn = rotation_vector_to_matrix(vector.ravel())
    return make_transform(turn, translation.ravel()) if result else None


@pytest.mark.parametrize("name", ["box", "can", "plate"])
def test_beats_opencv_on_anisotropic_noise_and_wild_corners(name):
    """Noise like a network's: 0.5–4 px, elongated; 40 % of the images have a wild corner."""
    cuboid, rng = CUBOIDS[name], np.random.default_rng(4)
    passed = []
    for _ in range(120):
        truth = look_at(cuboid, rng)
        sigma = np.exp(rng.uniform(np.log(0.5), np.log(4.0), 9))
        turn = rng.uniform(0, np.pi, 9)
        along, across = rng.normal(size=(2, 9)) * sigma * np.array([[1.3], [0.6]])
        noise = [np.cos(turn) * along - np.sin(turn) * across]
        noise += [np.sin(turn) * along + np.cos(turn) * across]
        pixels = project_keypoints(cuboid, truth, K) + np.stack(noise, axis=1)
        if rng.random() < 0.4:
            pixels[rng.integers(8)] = rng.uniform(0, 416, 2)
        ours = solve_pnp(cuboid, pixels, K, isotropic(sigma))
        check(ours, cuboid)
        flags = (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP)
        poses = (ours.T_cam_obj, *(opencv(cuboid, pixels, flag) for flag in flags))
        passed.append([add(T, truth, cuboid) < 0.1 for T in poses])
    our_rate, *other_rates = np.mean(passed, axis=0)
    assert our_rate >= max(other_rates) + 0.25
    assert our_rate >= 0.9


@pytest.mark.parametrize("name", ["box", "plate"])
def test_widenings_are_solved_in_turn_until_two_thirds_agree(name):
    cuboid, rng = CUBOIDS[name], np.random.default_rng(7)
    widened = set()
    for _ in range(40):
        pixels = project_keypoints(cuboid, look_at(cuboid, rng), K)
        pixels += rng.uniform(0, 6) * rng.normal(size=(9, 2))
        pixels[rng.random(9) < 0.2] = np.nan
        least = 2 * np.isfinite(pixels[:, 0]).sum() / 3
        best = None
        for factor in (1.0, 2.0, 4.0):
            item = solve_pnp(cuboid, pixels, K, isotropic(factor))
            if best is None or item.inliers.sum() > best.inliers.sum():
                best, chosen = item, factor
            if best.inliers.sum() >= least:
                break
        widened.add(chosen)
        result = solve_pnp(cuboid, pixels, K, widenings=(1.0, 2.0, 4.0))
        assert result.reason == best.reason
        assert_array_equal(result.inliers, best.inliers)
        if best.T_cam_obj is not None:
            assert_allclose(result.T_cam_obj, best.T_cam_obj, atol=1e-9)
            assert_allclose(result.covariance, best.covariance, rtol=1e-6, atol=1e-12)
    assert len(widened) == 3


DEGENERATE = {
    "three points": (CUBOIDS["box"][:3], [[0, 0], [100, 0], [0, 100]], "only 3 usable points"),
    "no points": (np.zeros((0, 3)), np.zeros((0, 2)), "only 0 usable points"),
    "no pixels": (CUBOIDS["box"], np.full((9, 2), np.nan), "only 0 usable points"),
    "infinite pixels": (CUBOIDS["box"], np.full((9, 2), np.inf), "only 0 usable points"),
    "huge pixels": (CUBOIDS["box"], np.arange(18).reshape(9, 2) * 1e300, "only 0 usable points"),
    "equal pixels": (CUBOIDS["box"], np.full((9, 2), 200.0), "only 1 distinct pixels"),
    "two pixels": (CUBOIDS["box"], [[0, 0]] * 4 + [[9, 9]] * 5, "only 2 distinct pixels"),
    "pixels on a line": (CUBOIDS["box"], [[20 * k, 10 * k] for k in range(9)], "on one line"),
    "pixels within their noise": (CUBOIDS["box"], 0.05 * CUBOIDS["box"][:, :2], "own noise"),
    "coincident points": (np.zeros((9, 3)), CUBOIDS["box"][:, :2] * 999, "extend over 0 m"),
    "points on a line": (np.outer(range(9), [1, 2, 3]), CUBOIDS["box"][:, :2] * 999, "on one line"),
    "huge points": (CUBOIDS["box"] * 1e300, CUBOIDS["box"][:, :2] * 999, "extend over"),
    "an extent that overflows": (np.sign(CUBOIDS["box"]) * 1e308, np.eye(9, 2), "extend over inf"),
}


@pytest.mark.parametrize(("object_points", "pixels", "reason"), DEGENERATE.values(), ids=DEGENERATE)
def test_degenerate_input_has_a_reason(object_points, pixels, reason):
    with np.errstate(all="ignore"):
        object_points, pixels = np.array(object_points, float), np.array(pixels, float)
    result = solve_pnp(object_points, pixels, K)
    check(result, object_points)
    assert reason in result.reason


SPECIAL = [0.0, 1.0, 200.0, np.nan, np.inf, -np.inf, 1e-300, 1e300]
NUMBERS = st.one_of(st.floats(), st.floats(-2, 2), st.sampled_from(SPECIAL))


@settings(max_examples=100)
@given(st.lists(st.lists(NUMBERS, min_size=6, max_size=6), max_size=9))
def test_any_numbers_give_a_valid_result(rows):
    table = np.array(rows, float).reshape(-1, 6)
    check(solve_pnp(table[:, :3], table[:, 3:5], K, isotropic(table[:, 5])), table[:, :3])


@pytest.mark.parametrize("spread", [0.01, 1.0, 30.0, 400.0, 1e5])
def test_random_pixels_never_give_a_wild_pose(spread):
    rng = np.random.default_rng(7)
    for name, sigma in (("box", 1.0), ("plate", 1.0), ("plate", 8.0), ("box off its origin", 0.5)):
        for _ in range(60):
            pixels = 200 + spread * rng.normal(size=(9, 2))
            pixels[rng.random(9) < 0.2] = np.nan
            check(solve_pnp(CUBOIDS[name], pixels, K, isotropic(sigma)), CUBOIDS[name])


def test_equal_points_and_pixels_never_give_a_wild_pose():
    rng, cuboid = np.random.default_rng(8), CUBOIDS["box"]
    for _ in range(150):
        pixels = rng.choice(rng.uniform(0, 400, (4, 2)), 9) + rng.choice([0, 1e-4]) * rng.normal()
        check(solve_pnp(cuboid, pixels, K), cuboid)
    coincident = np.vstack([cuboid[:1].repeat(6, 0), cuboid[:3]])  # on which OpenCV 5 raises
    check(solve_pnp(coincident, rng.uniform(0, 400, (9, 2)), K), coincident)


def test_lengths_must_match_and_the_camera_be_a_pinhole():
    cuboid = CUBOIDS["box"]
    with pytest.raises(ValueError, match="9 object points, 8 image points"):
        solve_pnp(cuboid, np.zeros((8, 2)), K)
    with pytest.raises(ValueError, match="broadcast"):
        solve_pnp(cuboid, np.zeros((9, 2)), K, isotropic(np.ones(8)))
    for bad in (np.full((3, 3), np.nan), np.zeros((3, 3)), np.eye(4), 2 * np.eye(3), K * 0 + 1):
        with pytest.raises(ValueError, match="invertible pinhole matrix"):
            solve_pnp(cuboid, cuboid[:, :2], bad)


def test_the_mirrored_start_avoids_the_wrong_tilt_of_plates():
    """Two tilts have almost the same image: the cost must decide, not the start."""
    cuboid, rng = CUBOIDS["plate"], np.random.default_rng(9)
    for _ in range(40):
        truth = make_transform(random_rotation(rng), np.array([0.02, -0.01, 0.9]))
        pixels = project_keypoints(cuboid, truth, K) + rng.normal(size=(9, 2)) * 0.3
        result = solve_pnp(cuboid, pixels, K, isotropic(0.3)).T_cam_obj
        at_truth, at_estimate = (
            np.fmin(((project(transform(T, cuboid), K) - pixels) ** 2).sum(1) / 0.3**2, 9).sum()
            for T in (truth, result)
        )
        assert at_estimate <= at_truth


def covariances(rng, n):
    """Return random covariances with standard deviations of 0.5 to 4 px."""
    angle, sigma = rng.uniform(0, np.pi, n), rng.uniform(0.5, 4, (n, 2))
    axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.einsum("ijn,nj,kjn->nik", axes, sigma**2, axes)


@pytest.mark.parametrize("name", ["box", "box off its origin", "plate"])
def test_the_covariance_matches_the_scatter_of_poses(name):
    rng = np.random.default_rng(5)
    cuboid = CUBOIDS[name]
    truth = look_at(cuboid, rng)
    pixels, sigma = project(transform(truth, cuboid), K), 0.02 * covariances(rng, 9)
    root = np.linalg.cholesky(sigma)
    steps, estimated = [], []
    for _ in range(400):
        noise = (root @ rng.normal(size=(9, 2, 1)))[..., 0]
        result = solve_pnp(cuboid, pixels + noise, K, covariance_px=sigma)
        if result.T_cam_obj is None or not result.inliers.all():
            continue
        turn = cv2.Rodrigues(result.T_cam_obj[:3, :3] @ truth[:3, :3].T)[0][:, 0]
        steps.append(np.concatenate([turn, (result.T_cam_obj - truth)[:3, 3]]))
        estimated.append(result.covariance)
    assert len(steps) > 350
    expected = np.mean(estimated, axis=0)
    scale = 1 / np.sqrt(np.diag(expected))
    scales = np.outer(scale, scale)
    assert_allclose(scales * np.cov(np.transpose(steps)), scales * expected, atol=0.25)
