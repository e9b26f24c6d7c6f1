"""A focal length from perspective: correct if the perspective shows, otherwise uncertain."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.focal import focal_factor
from dopepp.geometry.pnp import solve_pnp

PLATE = cuboid_keypoints(np.array([-0.05, -0.026, -0.0035]), np.array([0.05, 0.026, 0.0035]))
BOX = cuboid_keypoints(np.array([-0.05, -0.03, -0.04]), np.array([0.05, 0.03, 0.04]))
K = camera_matrix(500.0, 500.0, 319.5, 239.5)


def fit(cuboid, tilt_deg, factor, noise_px=0.0, seed=0):
    """Fit a focal length, which is ``factor`` times that of the assumed camera matrix."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_euler("zyx", [rng.uniform(-180, 180), tilt_deg, tilt_deg / 2], True)
    pixels = project_keypoints(cuboid, make_transform(turn.as_matrix(), [0.01, -0.01, 0.2]), K)
    pixels += rng.normal(size=pixels.shape) * noise_px
    wrong = K / np.array([[factor], [factor], [1.0]])
    wrong[:2, 2] = K[:2, 2]
    start = solve_pnp(cuboid, pixels, wrong, 100 * np.eye(2)).T_cam_obj
    return focal_factor(cuboid, pixels, start, wrong)


@pytest.mark.parametrize("cuboid", [PLATE, BOX], ids=["plate", "box"])
@pytest.mark.parametrize("factor", [0.4, 0.7, 1.0, 1.5, 2.5])
def test_exact_keypoints_determine_the_focal_length(cuboid, factor):
    assert fit(cuboid, 35, factor).factor == pytest.approx(factor, rel=1e-3)


def test_the_deviation_matches_the_error():
    result = [fit(BOX, 30, 2.0, noise_px=1.0, seed=seed) for seed in range(15)]
    off = np.log([focal.factor for focal in result]) - np.log(2)
    deviations = np.array([item.deviation for item in result])
    assert np.abs(off).max() < 0.3
    assert 0.6 < np.std(off / deviations) < 1.7
    assert np.median([item.gain for item in result]) > 10


def test_a_plate_that_faces_the_camera_is_uncertain():
    facing, tilted = (fit(PLATE, tilt, 2.0, noise_px=2.0) for tilt in (0, 40))
    assert facing.deviation > 3 * tilted.deviation


def test_the_right_lens_gains_nothing():
    result = [fit(BOX, 30, 1.0, noise_px=1.0, seed=seed) for seed in range(8)]
    assert max(item.gain for item in result) < 2


def test_seven_keypoints_are_too_few():
    pixels = project_keypoints(BOX, make_transform(np.eye(3), [0, 0, 0.3]), K)
    pixels[:2] = np.nan
    assert focal_factor(BOX, pixels, make_transform(np.eye(3), [0, 0, 0.3]), K) is None
