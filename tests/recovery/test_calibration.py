"""Corrections of distance, covariance and score, with features against a simulation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix, move_pose, project, transform
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.recovery.detection import (
    FEATURES,
    Detection,
    RecoveryOptions,
    calibrate,
    detection_features,
    recalibrate,
    score,
)  # fmt: skip

K = camera_matrix(600, 600, 320, 240)
CUBOID = cuboid_keypoints(np.array([-0.05, -0.03, -0.02]), np.array([0.05, 0.03, 0.02]))
T = move_pose(np.eye(4), np.array([0.3, -0.2, 1.0, 0.02, 0, 0.6]))


def detection(**changes):
    keypoints, covariance = project(transform(T, CUBOID), K), np.diag([1e-4] * 3 + [1e-6] * 3)
    whole = Detection("box", 0.5, 0.5, T, keypoints, keypoints.copy(), 1.0, covariance)
    return replace(whole, **changes)


def test_without_fitted_weights_the_score_is_the_mean_belief():
    weights = np.array([float(name == "belief") for name in FEATURES])
    for belief in (0.01, 0.3, 0.97):
        features = detection_features(detection(belief=belief), CUBOID, K)
        assert score(features, weights) == pytest.approx(belief)


def test_spread_is_the_rms_error_of_sampled_poses():
    rng = np.random.default_rng(0)
    root = rng.normal(0, 1, (6, 6)) * [0.01, 0.01, 0.01, 0.001, 0.001, 0.001]
    covariance = root.T @ root
    steps = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    moved = [transform(move_pose(T, step), CUBOID[:8]) for step in steps]
    distance = np.linalg.norm(np.array(moved) - transform(T, CUBOID[:8]), axis=2)
    size = np.linalg.norm(CUBOID[0] - CUBOID[6])
    expected = np.log(np.sqrt((distance**2).mean()) / size / 0.1)
    features = detection_features(detection(covariance=covariance), CUBOID, K)
    assert features[FEATURES.index("spread")] == pytest.approx(expected, abs=0.05)


def test_the_distance_changes_along_the_ray_through_the_origin():
    before = detection(belief=0.7)
    after = calibrate(before, CUBOID, K, RecoveryOptions(distance_factor=0.9))
    assert np.array_equal(after.T_cam_obj[:3, :3], T[:3, :3])
    assert np.allclose(after.T_cam_obj[:3, 3], [0.018, 0, 0.54], atol=1e-15)
    # The origin stays where it is in the image; the measured peaks stay as they are.
    origins = (project(item[:3, 3], K) for item in (after.T_cam_obj, T))
    assert np.allclose(*origins)
    assert np.allclose(after.keypoints, project(transform(after.T_cam_obj, CUBOID), K))
    assert np.array_equal(after.peaks, before.peaks)
    assert after.score == before.belief
    assert np.array_equal(calibrate(before, CUBOID, K, RecoveryOptions()).T_cam_obj, T)


def test_covariance_factor_leaves_the_score_unchanged():
    fitted = RecoveryOptions(score_bias=0.5, score_spread=-1.0, covariance_factor=2.5)
    sure = replace(fitted, covariance_factor=1.0)
    before, after = (calibrate(detection(), CUBOID, K, item) for item in (sure, fitted))
    assert after.score == before.score
    np.testing.assert_allclose(after.covariance, 2.5 * before.covariance)


def test_refined_factor_applies_to_poses_refined_on_the_image():
    refined = detection(agreement=0.9, probability=0.8)
    kept, by_depth_alone = detection(probability=0.7, kept="occluded"), detection()
    options = RecoveryOptions(refined_covariance_factor=0.25)
    calibrated = recalibrate([refined, kept, by_depth_alone], options)
    factors = [item.covariance[0, 0] / refined.covariance[0, 0] for item in calibrated]
    assert factors == [0.25, 1.0, 1.0]
    before = recalibrate([refined, kept, by_depth_alone], RecoveryOptions())
    assert [item.score for item in calibrated] == [item.score for item in before]
    with_depth = recalibrate([refined], options, by_depth=True)[0]
    assert np.array_equal(with_depth.covariance, refined.covariance)


@pytest.mark.parametrize("factor", [0.05, 5.0, float("nan"), "half"])
def test_impossible_refined_factor_is_rejected(factor):
    with pytest.raises(UserError, match="refined_covariance_factor"):
        RecoveryOptions.of({"refined_covariance_factor": factor})


def test_refined_score_is_the_verified_probability():
    judged = [
        replace(detection(), score=0.9, probability=0.2),
        replace(detection(), score=0.3, probability=0.8),
        replace(detection(), score=0.5),  # not verified
    ]
    scores = [estimate.score for estimate in recalibrate(judged, RecoveryOptions())]
    assert scores == pytest.approx([0.8, 0.5, 0.2])
    weights = {"refined_bias": -2.0, "refined_score": 1.0, "refined_verification": 0.5}
    fitted = RecoveryOptions(min_score=0.5, **weights)
    assert fitted.unrefined() == RecoveryOptions(min_score=0.5)
    best = max(recalibrate(judged, fitted), key=lambda estimate: estimate.score)
    assert best.score == 0.5
    (once,) = recalibrate(judged[:1], fitted)
    assert once.score == pytest.approx(expit(-2 + np.log(0.9 / 0.1) + 0.5 * np.log(0.2 / 0.8)))


def test_weights_of_former_features_are_ignored():
    former = {"min_score": 0.3, "refined_min_score": 0.6, "refined_agreement": 2.0}
    assert RecoveryOptions.of(former) == RecoveryOptions(min_score=0.3)
    with pytest.raises(UserError, match="refined_colour"):
        RecoveryOptions.of({"refined_colour": 1.0})


def test_features_show_missing_keypoints_and_worse_fits():
    peaks = project(transform(T, CUBOID), K)
    peaks[[1, 4, 6]] = np.nan
    both = detection(), detection(peaks=peaks, reprojection_error_px=5.0)
    whole, poor = (
        dict(zip(FEATURES, detection_features(item, CUBOID, K), strict=True)) for item in both
    )
    assert (whole["found"], poor["found"]) == (0, pytest.approx(-3 / 9))
    assert poor["misfit"] - whole["misfit"] == pytest.approx(np.log(5))


def test_corners_behind_the_camera_are_ignored():
    near = T.copy()
    near[2, 3] = 0.02
    assert np.isnan(project(transform(near, CUBOID[:8]), K)).any()
    assert np.isfinite(detection_features(detection(T_cam_obj=near), CUBOID, K)).all()


@given(belief=st.floats(0, 1), error=st.floats(0, 1e6), variance=st.floats(0, 1e12))
def test_features_of_any_detection_are_finite(belief, error, variance):
    item = detection(belief=belief, reprojection_error_px=error, covariance=variance * np.eye(6))
    features = detection_features(item, CUBOID, K)
    assert features.shape == (len(FEATURES),)
    assert np.isfinite(features).all()
    assert 0 < float(score(features, 10 * np.ones(len(FEATURES)))) < 1
