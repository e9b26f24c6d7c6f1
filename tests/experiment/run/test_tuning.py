"""Weights, factors and thresholds from detections, and the tuned checkpoint."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from dopepp.core.errors import UserError
from dopepp.data.sample import Instance, Sample
from dopepp.experiment.config.run_config import FalsePositiveTarget
from dopepp.experiment.run.scored_detections import ScoredDetections, matched_poses, score_images
from dopepp.experiment.run.tuned_factors import (
    MIN_REFINED,
    MIN_REFINED_FACTOR,
    WrongFocalLengths,
    fit_factors,
    fit_refined_factor,
)
from dopepp.experiment.run.tuning import MAX_LOST, MIN_REFINED_SCORE, choose, write_tuned
from dopepp.experiment.run.tuning_cache import TuningCache
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.refinement.region.shared_errors import SCALE_ERROR
from dopepp.metrics.functional import expected_calibration_error
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.network import build_network
from dopepp.parts import load_part
from dopepp.recovery.detection import FEATURES, PROBABLE, REFINED_FEATURES, Detection, score
from tests.data.makers import MadeSource


def source_of(*poses: np.ndarray | None, visible_fraction: float = 1.0) -> MadeSource:
    """Return images of the part, with their number in every pixel; None shows no part."""

    def make(index: int, epoch: int) -> Sample:
        image, T = np.full((128, 128, 3), index, np.uint8), poses[index]
        if T is None:
            return Sample(image, K)
        keypoints = project_keypoints(PART.cuboid, T, K)
        return Sample(image, K, [Instance(PART.name, T, keypoints, visible_fraction)])

    return MadeSource(make, len(poses))


def noise() -> MadeSource:
    """Return a source of three images of noise."""

    def make(index: int, epoch: int) -> Sample:
        image = np.random.default_rng([index, epoch]).integers(0, 256, (64, 64, 3), np.uint8)
        instance = Instance("servoholder", np.eye(4), np.zeros((9, 2)))
        return Sample(image, K, [replace(instance, mask=np.zeros((64, 64), bool))])

    return MadeSource(make, 3, "noise")


K = camera_matrix(300, 300, 64, 64)
NOTHING = ScoredDetections(
    np.zeros((0, len(FEATURES))), np.zeros(0), np.zeros(0, bool), np.zeros(0, int),
    ["photos"] * 100, 0,
)  # fmt: skip


FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
PART = load_part("pivconnector")
POSE = make_transform(np.eye(3), np.array([0.0, 0.0, 0.5]))
VERIFIES = SimpleNamespace(verifies=True)


def best_scores(empty: ScoredDetections, options: dict[str, float]) -> np.ndarray:
    """Return the best score of each image without objects, with the chosen weights."""
    weights = np.array([options[f"score_{name}"] for name in FEATURES])
    return empty.best_scores(score(empty.features, weights))


def scored(seed: int, count: int, right: bool = True) -> ScoredDetections:
    """Return detections whose features determine the probability of being correct."""
    rng = np.random.default_rng(seed)
    features = np.column_stack([np.ones(count), rng.normal(size=(count, 4)) - (0 if right else 2)])
    truth = score(features, np.array([0.0, 2.0, -1.0, -0.5, 0.0]))
    correct = (rng.random(count) < truth) & right
    image = rng.permutation(count)
    return ScoredDetections(features, rng.random(count), correct, image, ["photos"] * count, count)


def test_scores_are_calibrated_and_low_on_images_without_objects():
    options = choose(scored(0, 3000), scored(1, 1000, right=False))
    weights = np.array([options[f"score_{name}"] for name in FEATURES])
    shown, empty = scored(2, 3000), scored(3, 1000, right=False)
    scores = np.concatenate([score(item.features, weights) for item in (shown, empty)])
    correct = np.concatenate([shown.correct, empty.correct])
    assert expected_calibration_error(torch.from_numpy(scores), torch.from_numpy(correct)) < 0.05
    loud = best_scores(empty, options) >= options["min_score"]
    assert loud.mean() <= 4 * FalsePositiveTarget.false_positive_rate
    assert options["min_score"] < 1


TWO, OCCLUDED = source_of(POSE, None), source_of(POSE, None, visible_fraction=0.05)


def test_the_threshold_meets_the_false_positive_rate():
    shown, empty = scored(4, 500), scored(5, 250, right=False)
    for rate in (0.0, 0.005, 0.1):
        options = choose(shown, empty, rate)
        assert (best_scores(empty, options) >= options["min_score"]).sum() == int(rate * 250)
    assert choose(shown, empty, 1.0)["min_score"] == 0.0
    assert choose(scored(6, 300), NOTHING)["min_score"] < 1e-300  # silence needs no threshold


@pytest.mark.parametrize(("correct", "what"), [(False, "incorrect"), (True, "correct")])
def test_tuning_needs_correct_and_incorrect_detections(correct, what):
    with pytest.raises(UserError, match=f"all of them {what}"):
        choose(replace(scored(7, 50), correct=np.full(50, correct)), NOTHING)
    with pytest.raises(UserError, match="no detection on any"):
        choose(NOTHING, NOTHING)


def found(T: np.ndarray, certainty: float, shift: float = 0.0, **changes: Any) -> Detection:
    """Return a detection at a pose, shifted by a share of the part's diameter."""
    moved = T.copy()
    moved[0, 3] += shift * PART.diameter
    points = project_keypoints(PART.cuboid, moved, K)
    scores, covariance = (certainty, certainty), 1e-6 * np.eye(6)
    made = Detection(PART.name, *scores, moved, points, points, 1.0, covariance)
    return replace(made, **changes)


def estimator(*detections: Detection, refiner: object = None) -> Any:
    return SimpleNamespace(candidates=lambda image, K, **_: list(detections), refiner=refiner)


def test_correct_detections_match_once_within_a_tenth_of_the_diameter():
    detections = [found(POSE, 0.9, 0.05), found(POSE, 0.8, 0.05), found(POSE, 0.7, 0.2)]
    result = score_images(estimator(*detections), [PART], TWO)
    # A duplicate is wrong, and so are all detections on the image without the part.
    assert result.correct.tolist() == [True, False, False, False, False, False]
    assert (result.num_images, result.num_instances) == (2, 1)
    far = estimator(found(POSE, 0.9, 0.2))
    assert not score_images(far, [PART], TWO).correct.any()


def test_detections_of_occluded_instances_do_not_count():
    result = score_images(estimator(found(POSE, 0.9), found(POSE, 0.8)), [PART], OCCLUDED)
    # The best detection matches the occluded instance and does not count. The duplicate is wrong,
    # and so are both detections on the image without the part.
    assert result.correct.tolist() == [False, False, False]
    assert (result.scores.tolist(), result.num_instances) == ([0.8, 0.9, 0.8], 0)


def test_matched_poses_include_equivalent_poses():
    near, stray = found(POSE, 0.9, 0.05), found(POSE, 0.8, 3.0)
    ((pose, true),) = matched_poses(estimator(near, stray), [PART], TWO)
    assert pose is near
    assert np.array_equal(true, POSE[None])
    symmetric = replace(PART, symmetries_discrete=FLIP[None])
    ((_, alike),) = matched_poses(estimator(near), [symmetric], TWO)
    assert np.array_equal(alike, [POSE, POSE @ FLIP])
    assert matched_poses(estimator(near), [PART], OCCLUDED) == []


def test_factors_of_a_biased_and_overconfident_network():
    rng = np.random.default_rng(0)
    deviation = np.array([0.02, 0.02, 0.01, 0.002, 0.002, 0.004])
    pairs = []
    for number in range(2000):
        step = 1.5 * deviation * rng.normal(size=6)
        turn = rotation_vector_to_matrix(step[:3])
        T = make_transform(turn @ POSE[:3, :3], 0.9 * (POSE[:3, 3] + step[3:]))
        equivalents = np.array([POSE, POSE @ FLIP][:: -1 if number % 3 == 0 else 1])
        pairs.append((found(T, 0.9, covariance=np.diag(deviation**2)), equivalents))
    factors = fit_factors(pairs)
    assert factors["distance_factor"] == pytest.approx(1 / 0.9, rel=0.01)
    assert factors["covariance_factor"] == pytest.approx(2.25, rel=0.1)
    assert fit_factors([]) == {"distance_factor": 1.0, "covariance_factor": 1.0}


class Refining:
    """Estimator whose errors have known covariances; every fifth pose is wrong or kept."""

    def __init__(self, true: float) -> None:
        self.true = true

    def candidates(self, image: np.ndarray, K: np.ndarray, **_: object) -> list[Detection]:
        number = int(image[0, 0, 0])
        if number % 5 == 0:
            return [found(POSE, 0.9, 0.3, agreement=0.9)]
        deviation = np.array([0.01, 0.01, 0.01, 0.001, 0.001, 0.002])
        step = np.sqrt(self.true) * deviation * np.random.default_rng(number).normal(size=6)
        T = make_transform(rotation_vector_to_matrix(step[:3]), POSE[:3, 3] + step[3:])
        if number % 5 == 1:
            return [found(T, 0.9, covariance=np.eye(6), agreement=None)]
        return [found(T, 0.9, covariance=np.diag(deviation**2), agreement=0.9)]


def refined_factor(true: float, count: int = 250) -> float:
    return fit_refined_factor(Refining(true), [PART], source_of(*[POSE] * count))  # type: ignore[arg-type]


@pytest.mark.parametrize(("true", "fitted"), [(0.8, 0.8), (0.3, MIN_REFINED_FACTOR)])
def test_the_refined_factor_is_fitted_to_correct_poses(true, fitted):
    assert refined_factor(true) == pytest.approx(fitted, rel=0.15)


def test_the_focal_length_is_wrong_by_up_to_the_scale_error():
    source = WrongFocalLengths(source_of(*[POSE] * 200))
    cameras = [source.sample(index).K for index in range(len(source))]
    errors = np.array([camera[0, 0] / K[0, 0] - 1 for camera in cameras])
    assert np.abs(errors).max() <= SCALE_ERROR
    assert np.std(errors) == pytest.approx(SCALE_ERROR / math.sqrt(3), rel=0.1)
    assert abs(np.mean(errors)) < 3 * SCALE_ERROR / math.sqrt(3 * 200)
    again = source.sample(7).K
    assert_array_equal(again, cameras[7])
    assert again[1, 1] / K[1, 1] == pytest.approx(again[0, 0] / K[0, 0])


def test_a_wrong_focal_length_keeps_the_pixels_and_distances_of_parts():
    sample, shifts = source_of(POSE).sample(0), ((0.2, -0.1, 0.0), (-0.3, 0.1, 0.2), (0, 0, 0))
    poses = [make_transform(POSE[:3, :3], POSE[:3, 3] + shift) for shift in shifts]
    right = replace(sample, instances=[replace(sample.instances[0], T_cam_obj=T) for T in poses])
    source: Any = SimpleNamespace(name="beside", sample=lambda index, epoch: right)
    wrong = WrongFocalLengths(source).sample(3)
    assert wrong.K[0, 0] != right.K[0, 0]
    assert_array_equal(wrong.instances[0].T_cam_obj, poses[0])
    for before, instance in zip(poses, wrong.instances, strict=True):
        after = instance.T_cam_obj
        center, turned = before[:3, 3], after[:3, 3]
        pixel, seen = right.K @ center / center[2], wrong.K @ turned / turned[2]
        assert_allclose(seen, pixel, atol=1e-4)
        assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(center))
        assert_allclose(after[:3, :3] @ before[:3, :3].T @ center, turned, atol=1e-12)


def test_few_refined_poses_keep_their_covariances(caplog):
    assert refined_factor(0.4, MIN_REFINED) == 1.0
    assert f"12 correct poses, fewer than {MIN_REFINED}" in caplog.text
    with pytest.raises(UserError, match="refinement is far too confident"):
        refined_factor(9.0)


def test_refined_poses_are_scored_by_their_verification():
    sure = found(POSE, 0.3, probability=0.9)
    result = score_images(estimator(sure, refiner=VERIFIES), [PART], TWO)
    expected = [1.0, np.log(0.3 / 0.7), np.log(0.9 / 0.1)]
    np.testing.assert_allclose(result.features, [expected, expected])
    nothing = score_images(estimator(refiner=VERIFIES), [PART], TWO)
    assert nothing.features.shape == (0, 3)
    unverified = estimator(sure, refiner=SimpleNamespace(verifies=False))
    assert score_images(unverified, [PART], TWO).features.shape == (2, len(FEATURES))


def test_lookalikes_do_not_raise_the_threshold():
    shown, empty = scored(8, 500), scored(9, 100, right=False)
    alike = replace(empty, kinds=["look-alikes" if k % 2 else "photos" for k in range(100)])
    options = choose(shown, alike, 0.0)
    photos = best_scores(empty, options)[::2]
    assert np.nextafter(photos.max(), 1.0) == options["min_score"]
    assert alike.shows_lookalikes().sum() == 50


def test_refined_poses_far_below_even_odds_are_not_reported(caplog):
    rng = np.random.default_rng(0)
    features = np.column_stack([np.ones(200), rng.normal(size=(200, 2))])
    correct = rng.random(200) < score(features, np.array([0.0, 0.0, 1.0]))
    shown = ScoredDetections(
        features, rng.random(200), correct, np.arange(200), ["photos"] * 200, 200
    )
    nothing = replace(NOTHING, features=np.zeros((0, 3)))
    assert choose(shown, nothing, refined=True)["refined_min_score"] == MIN_REFINED_SCORE
    loud = replace(nothing, features=np.array([[1.0, 0.0, 20.0]]), correct=np.zeros(1, bool))
    loud = replace(loud, scores=np.zeros(1), image=np.zeros(1, int))
    assert choose(shown, loud, 1.0, refined=True)["refined_min_score"] == 0.0
    # A deceptive frame costs poses that are probably wrong, and a hundredth of the correct ones.
    assert choose(shown, loud, 0.0, refined=True)["refined_min_score"] == PROBABLE
    sure = replace(shown, features=features + np.outer(correct, [0.0, 0.0, 6.0]))
    options = choose(sure, loud, 0.0, refined=True)
    weights = np.array([options[f"refined_{name}"] for name in REFINED_FEATURES])
    lost = score(sure.features, weights)[correct] < options["refined_min_score"]
    assert PROBABLE < options["refined_min_score"] < 1.0
    assert lost.mean() == pytest.approx(MAX_LOST, abs=0.02)
    assert "a higher threshold would lose" in caplog.text
    # If all poses are correct, the weights stay at their defaults.
    same = choose(replace(shown, correct=np.ones(200, bool)), nothing, refined=True)
    assert [same[f"refined_{name}"] for name in ("bias", "score", "verification")] == [0, 0, 1]


def test_equivalent_poses_of_a_symmetric_part_are_correct():
    mirrored = replace(PART, points=np.vstack([PART.points, PART.points @ FLIP[:3, :3]]))
    turned = estimator(found(POSE @ FLIP, 0.9))
    assert not score_images(turned, [mirrored], TWO).correct.any()
    symmetric = replace(mirrored, symmetries_discrete=FLIP[None])
    assert score_images(turned, [symmetric], TWO).correct.tolist() == [True, False]


@pytest.mark.parametrize("name", ["best.ckpt", "best.safetensors"])
def test_the_tuned_checkpoint_is_written_next_to_the_original(tiny_spec, tmp_path, name):
    weights = build_network(tiny_spec).state_dict()
    former = {"max_angle_deg": 30.0, "refined_agreement": 2.0}  # of an older tuning
    old = Checkpoint(tiny_spec, weights, [PART], (128, 96), 8, 1.0, former)
    chosen = {"min_score": 0.5, "score_bias": -1.5, "distance_factor": 0.95}
    path = write_tuned(old, tmp_path / name, {**chosen, "refined_min_score": 0.7})
    assert path == tmp_path / "best_tuned.ckpt"
    recovery = PoseEstimator.load(path).recovery
    assert (recovery.max_angle_deg, recovery.min_score) == (30.0, 0.5)
    assert (recovery.distance_factor, recovery.refined_min_score) == (0.95, 0.7)
    assert recovery.score_weights == (-1.5, 1.0, 0.0, 0.0, 0.0)


def test_items_of_a_source_are_cached_up_to_the_limit():
    source, other = noise(), noise()
    cache = TuningCache(max_bytes=2 * 64 * 64 * 4)  # of two images with their masks
    cached, other_cached = cache.of(source), cache.of(other)
    assert len(cached) == 3
    for _ in range(2):
        for index in range(3):
            assert (cached.sample(index).image == source.sample(index).image).all()
    assert [source.requests.count((index, 0)) for index in range(3)] == [3, 3, 4]
    cached.sample(0, epoch=1)
    assert (0, 1) in source.requests
    other_cached.sample(0)
    assert other.requests == [(0, 0)]  # items of other sources are separate


@pytest.mark.parametrize(("most", "length"), [(1, 1), (2, 2), (3, 3), (9, 3)])
def test_a_source_ends_when_it_has_enough_instances(most, length):
    source = noise()
    cached = TuningCache().of(source, most)
    assert len(cached) == length
    assert source.requests == [(index, 0) for index in range(length)]


def test_a_network_runs_once_per_image(tiny_spec):
    torch.manual_seed(0)
    network = build_network(tiny_spec)
    part = load_part("servoholder")
    checkpoint = Checkpoint(tiny_spec, network.state_dict(), [part], (64, 64), 8, 1.0, {})
    estimator = NetworkEstimator(network, checkpoint)
    passes: list[int] = []
    estimator.network.register_forward_hook(lambda *_: passes.append(1))
    cached = TuningCache().with_cached_maps(estimator)
    first, second = (noise().sample(index).image for index in range(2))
    for image in (first, second, first, first[::-1].copy(), second):
        for left, same in zip(cached.maps(image), estimator.maps(image), strict=True):
            torch.testing.assert_close(left, same, rtol=0, atol=0)
    assert len(passes) == 5 + 3
    cached.recovery = None  # the original estimator is unchanged
    assert estimator.recovery is not None
