import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dopepp.geometry.camera import make_transform, moved, step_between
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.tracker import PERSISTENCE, SUDDEN, Motion, at_rest

START = make_transform(rotation_vector_to_matrix(np.array([0.3, -0.2, 1.0])), [0.02, -0.01, 0.3])
NOISE = np.repeat([math.radians(0.5), 0.0005], 3)


def filtered(motion: Motion, T: np.ndarray) -> Motion:
    """Let a frame see a pose with NOISE, fused with the forecast as refinement does it."""
    prior, own = np.linalg.inv(motion.pose_covariance), np.diag(1 / NOISE**2)
    covariance = np.linalg.inv(prior + own)
    step = covariance @ own @ step_between(motion.T_cam_obj, T)
    return motion.seen(moved(motion.T_cam_obj, step), covariance)


def test_what_a_frame_says_is_kalmans_update() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(12, 12)) * np.tile(NOISE, 2)[:, None]
    forecast = Motion(START, rng.normal(size=6) * 0.01, root @ root.T, np.zeros(6))
    measured = rng.normal(size=6) * 1e-4  # small, so that turns add up
    found = filtered(forecast, moved(START, measured))
    H = np.eye(6, 12)
    P, R = forecast.covariance, np.diag(NOISE**2)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    assert_allclose(found.covariance, P - gain @ H @ P, atol=1e-12)
    after = gain @ measured
    assert_allclose(step_between(START, found.T_cam_obj), after[:6], atol=1e-9)
    assert_allclose(found.velocity, forecast.velocity + after[6:], atol=1e-9)


def test_a_steady_motion_is_foreseen() -> None:
    step = np.array([0, math.radians(6), 0, 0.01, 0, 0])
    motion, T = at_rest(START, np.diag(NOISE**2)), START
    for _ in range(15):
        T = moved(T, step)
        motion = filtered(motion.ahead(), T)
    miss = step_between(motion.ahead().T_cam_obj, moved(T, step))
    assert np.abs(miss[:3]).max() < math.radians(0.5)
    assert np.abs(miss[3:]).max() < 0.001


def test_a_part_at_rest_trembles_less_than_what_is_seen_of_it() -> None:
    rng = np.random.default_rng(1)
    motion, steps = at_rest(START, np.diag(NOISE**2)), []
    for _ in range(80):
        after = filtered(motion.ahead(), moved(START, rng.normal(size=6) * NOISE))
        steps.append(step_between(motion.T_cam_obj, after.T_cam_obj))
        motion = after
    trembling = np.sqrt(np.mean(np.square(steps[20:]), axis=0) / 2)
    assert (trembling < 0.75 * NOISE).all(), trembling / NOISE
    assert np.linalg.eigvalsh(motion.covariance).min() > 0


@pytest.mark.parametrize("sudden", [False, True])
def test_unseen_it_becomes_less_certain_and_slower(sudden: bool) -> None:
    motion = at_rest(START, np.diag(NOISE**2))
    motion = Motion(START, np.array([0, 0, 0.02, 0.003, 0, 0]), motion.covariance, np.zeros(6))
    later = motion.ahead(sudden)
    assert_allclose(later.velocity, PERSISTENCE * motion.velocity)
    assert (np.diag(later.pose_covariance) > np.diag(motion.pose_covariance)).all()
    if sudden:
        least = np.repeat([SUDDEN[0], SUDDEN[1] * START[2, 3]], 3)
        assert (np.diag(later.pose_covariance) > least**2).all()
