"""Fits of the factors on drawn errors, and of the score's logistic model against scipy's."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2

from dopepp.core.errors import UserError
from dopepp.experiment.run.calibration_fits import (
    fit_covariance_factor,
    fit_distance_factor,
    fit_weights,
)
from dopepp.geometry.camera import make_transform
from dopepp.recovery.detection import DISTANCE_FACTORS, score


def test_the_factor_is_the_median_ratio_of_distances():
    rng = np.random.default_rng(0)
    true = np.tile(make_transform(np.eye(3), [0.02, 0, 0.6]), (201, 1, 1))
    true[:, :3, 3] += rng.uniform(-0.1, 0.1, (201, 3))
    estimated = true.copy()
    estimated[:, :3, 3] *= rng.normal(1.07, 0.02, (201, 1))
    estimated[:30, :3, 3] *= 3  # gross errors change a median little
    assert fit_distance_factor(estimated, true) == pytest.approx(1 / 1.07, abs=0.01)
    assert fit_distance_factor(true[:0], true[:0]) == 1.0
    assert fit_distance_factor(100 * true, true) == DISTANCE_FACTORS[0]


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


def test_few_refined_poses_hardly_change_the_weights():
    rng, usual = np.random.default_rng(0), np.array([0.0, 0.0, 1.0])
    features = np.column_stack([np.ones(4), rng.normal(size=(4, 2))])
    few = fit_weights(features, np.array([True, False, True, False]), usual)
    assert few[1] == pytest.approx(0.0, abs=1.5)
    many = np.column_stack([np.ones(5000), rng.normal(size=(5000, 2))])
    truth = np.array([-1.0, 0.5, 2.0])
    fitted = fit_weights(many, rng.random(5000) < score(many, truth), usual)
    np.testing.assert_allclose(fitted, truth, atol=0.2)


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
