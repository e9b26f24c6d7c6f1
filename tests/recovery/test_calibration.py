"""The score's logistic model against scipy's, and its features against a simulation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import chi2

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix, move_pose, project, transform
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.recovery.detection import (
    DISTANCE_FACTORS,
    FEATURES,
    Detection,
    RecoveryOptions,
    calibrate,
    detection_features,
    fit_covariance_factor,
    fit_distance_factor,
    fit_weights,
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


def test_the_factor_is_the_median_ratio_of_distances():
    rng = np.random.default_rng(0)
    true = np.tile(T, (201, 1, 1))
    true[:, :3, 3] += rng.uniform(-0.1, 0.1, (201, 3))
    estimated = true.copy()
    estimated[:, :3, 3] *= rng.normal(1.07, 0.02, (201, 1))
    estimated[:30, :3, 3] *= 3  # gross errors change a median little
    assert fit_distance_factor(estimated, true) == pytest.approx(1 / 1.07, abs=0.01)
    assert fit_distance_factor(true[:0], true[:0]) == 1.0
    assert fit_distance_factor(100 * true, true) == DISTANCE_FACTORS[0]


def test_covariance_factor_leaves_the_score_unchanged():
    fitted = RecoveryOptions(score_bias=0.5, score_spread=-1.0, covariance_factor=2.5)
    sure = replace(fitted, covariance_factor=1.0)
    before, after = (calibrate(detection(), CUBOID, K, item) for item in (sure, fitted))
    assert after.score == before.score
    np.testing.assert_allclose(after.covariance, 2.5 * before.covariance)


def test_covariance_factor_of_chi_squared_distances():
    drawn = 3.0 * chi2(6).rvs(20_000, random_state=0)
    assert fit_covariance_factor(drawn) == pytest.approx(3.0, rel=0.05)
    assert fit_covariance_factor(drawn[:0]) == 1.0


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_wrong_poses_do_not_raise_the_covariance_factor(share):
    rng = np.random.default_rng(0)
    drawn = 2.0 * chi2(6).rvs(400, random_state=0)
    wrong = rng.random(400) < share
    drawn[wrong] = 10 ** rng.uniform(1.5, 6.0, wrong.sum())
    assert np.quantile(drawn, 0.9) / chi2(6).ppf(0.9) > 3.0
    assert fit_covariance_factor(drawn) == pytest.approx(2.0, rel=0.25)


@pytest.mark.parametrize(("factor", "lean"), [(30.0, "too confident"), (0.05, "too cautious")])
@pytest.mark.parametrize("refined", [False, True])
def test_extreme_covariance_factor_is_rejected(factor, lean, refined):
    whose = "refinement" if refined else "network"
    with pytest.raises(UserError, match=f"{whose} is far {lean}"):
        fit_covariance_factor(factor * chi2(6).rvs(500, random_state=0), refined=refined)


def test_refined_poses_may_have_a_smaller_factor():
    drawn = 0.3 * chi2(6).rvs(20_000, random_state=0)
    assert fit_covariance_factor(drawn, refined=True) == pytest.approx(0.3, rel=0.05)
    with pytest.raises(UserError, match=r"a factor from 0\.5 to 4"):
        fit_covariance_factor(drawn)


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


def test_few_refined_poses_hardly_change_the_weights():
    rng, usual = np.random.default_rng(0), np.array([0.0, 0.0, 1.0])
    features = np.column_stack([np.ones(4), rng.normal(size=(4, 2))])
    few = fit_weights(features, np.array([True, False, True, False]), usual)
    assert few[1] == pytest.approx(0.0, abs=1.5)
    many = np.column_stack([np.ones(5000), rng.normal(size=(5000, 2))])
    truth = np.array([-1.0, 0.5, 2.0])
    fitted = fit_weights(many, rng.random(5000) < score(many, truth), usual)
    np.testing.assert_allclose(fitted, truth, atol=0.2)


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


def test_the_fit_is_the_maximum_of_the_likelihood():
    rng = np.random.default_rng(3)
    features = np.column_stack([np.ones(400), rng.normal(size=(400, 4))])
    truth = np.array([0.5, 1.5, -1.0, 0.0, 0.3])
    correct = rng.random(400) < score(features, truth)

    def loss(weights):
        log_odds = features @ weights
        ridge = 0.05 * (weights[1:] ** 2).sum()
        return np.logaddexp(0, log_odds).sum() - log_odds[correct].sum() + ridge

    fitted = fit_weights(features, correct)
    np.testing.assert_allclose(fitted, minimize(loss, np.zeros(5), tol=1e-12).x, atol=1e-4)
    np.testing.assert_allclose(fitted, truth, atol=0.5)


@pytest.mark.parametrize("correct", [np.ones(5, bool), np.zeros(5, bool), np.zeros(0, bool)])
def test_correct_and_incorrect_detections_are_required(correct):
    with pytest.raises(ValueError, match="correct and incorrect"):
        fit_weights(np.ones((len(correct), 2)), correct)
