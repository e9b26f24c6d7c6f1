"""Template estimator; its detector is replaced by a detector with start poses near the truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from dopepp import PoseEstimator
from dopepp.core.errors import UserError
from dopepp.geometry.rotation import rotation_angle, rotation_vector_to_matrix
from dopepp.inference.template_estimator import NUM_REFINED
from dopepp.inference.tracker import PoseTracker
from dopepp.parts.catalogue import pivconnector
from dopepp.recovery.reasons import format_reasons
from dopepp.virtual import PRESETS, Factory

NEAR, FAR = 0.08, 0.2


@pytest.fixture
def estimator(near_truth):
    return PoseEstimator.from_mesh("pivconnector", working_distance=(NEAR, FAR))


@pytest.fixture(scope="module")
def rendered():
    preset = replace(PRESETS["quickstart"].resized(320, 320), targets_per_image=(1, 1))
    return Factory([pivconnector()], preset, 7).render(0, 1)


def true_pose(rendered):
    return rendered.scene.objects[rendered.scene.targets[0]].T_cam_obj


def test_starts_are_refined_verified_and_merged_by_instance(near_truth, estimator, rendered):
    image, K, truth = rendered.image, rendered.scene.K, true_pose(rendered)
    near_truth.truth = [truth]
    (detection,) = estimator.predict(image, K, roi=(0, 0, 300, 300))
    assert estimator.detectors[0].asked == [((NEAR, FAR), (0, 0, 300, 300))]
    turn = rotation_angle(detection.T_cam_obj[:3, :3].T @ truth[:3, :3])
    assert np.degrees(turn) < 1
    assert np.linalg.norm(detection.T_cam_obj[:3, 3] - truth[:3, 3]) < 0.002
    odds = detection.probability / (1 - detection.probability)
    slope = estimator.recovery.refined_verification
    assert detection.score == pytest.approx(1 / (1 + odds**-slope))  # at a silent level of 0
    assert detection.score >= estimator.min_score == 0.5
    passed, weaker = estimator.reporting(0.0).split(estimator.candidates(image, K))
    assert passed[0].score == detection.score
    assert weaker == []


def test_starts_with_the_best_outlines_are_refined_whatever_their_scores(estimator, rendered):
    image, K, truth = rendered.image, rendered.scene.K, true_pose(rendered)
    (detector,), rng = estimator.detectors, np.random.default_rng(5)
    starts = []
    for shift in rng.uniform(-0.03, 0.03, (NUM_REFINED + 10, 3)):
        T = truth.copy()
        T[:3, :3] = rotation_vector_to_matrix(rng.normal(size=3)) @ T[:3, :3]
        T[:3, 3] += shift
        starts.append(detector.start(T, 0.9, K))
    T = truth.copy()
    T[:3, :3] = rotation_vector_to_matrix(np.array([0.02, 0.02, 0])) @ T[:3, :3]
    starts.append(detector.start(T, 0.1, K))
    ends = estimator.refined(starts, image, K)
    assert len(ends) <= NUM_REFINED
    best = max(ends, key=lambda end: end.probability)
    assert np.linalg.norm(best.T_cam_obj[:3, 3] - truth[:3, 3]) < 0.002
    assert estimator.refiner.coarse_fit(starts[-1], image, K) > 0.8
    T[:2, 3] += 1.0  # beside the image
    assert estimator.refiner.coarse_fit(detector.start(T, 0.1, K), image, K) == 0.0


def test_the_best_pose_is_refined_after_half_turns(near_truth, estimator, rendered, monkeypatch):
    image, K, truth = rendered.image, rendered.scene.K, true_pose(rendered)
    half_turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    near_truth.truth = [truth @ half_turn]
    wrong, *_ = estimator.candidates(image, K)
    assert np.degrees(rotation_angle(wrong.T_cam_obj[:3, :3].T @ truth[:3, :3])) > 90
    monkeypatch.setattr(near_truth, "half_turned", lambda self, T: [T, T @ half_turn])
    best, *_ = estimator.candidates(image, K)
    assert np.degrees(rotation_angle(best.T_cam_obj[:3, :3].T @ truth[:3, :3])) < 1
    assert best.score > wrong.score


def test_distinctive_lines_decide_between_equally_probable_poses(near_truth, estimator, rendered):
    image, K, truth = rendered.image, rendered.scene.K, true_pose(rendered)
    (detector,) = estimator.detectors
    poses = [truth @ np.diag([-1.0, 1.0, -1.0, 1.0]), truth, truth.copy()]
    poses[2][0, 3] += 0.2  # another instance
    ends = [
        replace(detector.start(pose, 0.5, K), probability=probability)
        for pose, probability in zip(poses, (0.9, 0.85, 0.8), strict=True)
    ]
    kept = estimator._without_look_alikes(ends, image, K)
    assert [id(end) for end in kept] == [id(ends[1]), id(ends[2])]
    ends[1] = replace(ends[1], probability=0.5)  # too improbable to be compared
    kept = estimator._without_look_alikes(ends, image, K)
    assert [id(end) for end in kept] == [id(ends[0]), id(ends[2])]


def test_the_given_distances_replace_the_working_distance(estimator, rendered):
    estimator.candidates(rendered.image, rendered.scene.K, distances=(0.2, 0.3))
    estimator.candidates(rendered.image, rendered.scene.K, distances="any")
    assert estimator.detectors[0].asked == [((0.2, 0.3), None), ((NEAR, FAR), None)]


def test_an_empty_image_is_explained(near_truth, estimator, rendered):
    image, K = rendered.image, rendered.scene.K
    assert estimator.predict(image, K) == []
    text = "pivconnector: no view of the part fits the image at 0.08 – 0.2 m"
    assert format_reasons(estimator.explain(image, K)) == text
    T = true_pose(rendered).copy()
    T[:3, 3] += [0.03, 0.03, 0.05]  # beside the part
    near_truth.truth = [T]
    assert "once refined, score" in format_reasons(estimator.reporting(1.0).explain(image, K))


def test_template_estimator_tracks_and_streams(near_truth, estimator, rendered, tmp_path):
    near_truth.truth = [true_pose(rendered)]
    tracker, identities = PoseTracker(estimator), set()
    for _ in range(3):
        (track,) = tracker.track(rendered.image, rendered.scene.K)
        identities.add(track.identity)
    assert (len(identities), len(estimator.detectors[0].asked)) == (1, 1)
    path = tmp_path / "image.png"
    cv2.imwrite(str(path), rendered.image[..., ::-1])
    (result,) = estimator.stream(path, rendered.scene.K)
    assert [it.object for it in result.detections] == ["pivconnector"]
    assert result.speed["refine"] > 0


def test_repr_states_part_distances_and_thresholds(estimator):
    text = repr(estimator)
    assert "templates of meshes, cpu, refine=region" in text
    assert "pivconnector: 105 × 52 × 7 mm, at 0.08 – 0.2 m" in text


def test_options_reach_the_part_and_the_detector(near_truth, tmp_path):
    path = tmp_path / "box.off"
    corners = [f"{x} {y} {z}" for x in (0, 40) for y in (0, 30) for z in (0, 20)]
    quads = ["0 1 3 2", "4 6 7 5", "0 4 5 1", "2 3 7 6", "0 2 6 4", "1 5 7 3"]
    path.write_text("\n".join(["OFF", "8 6 0", *corners, *(f"4 {quad}" for quad in quads)]))
    estimator = PoseEstimator.from_mesh(path, "mm", (0.2, 0.3), tilt_deg=40, name="block")
    (part,) = estimator.parts
    assert (part.name, part.unit) == ("block", "mm")
    assert part.diameter == pytest.approx(np.linalg.norm([0.04, 0.03, 0.02]))
    assert len(part.symmetries_discrete) == 3  # half turns of a box
    assert estimator.detectors[0].tilt_deg == 40
    assert estimator.detectors[0].working_distance == (0.2, 0.3)
    plain = PoseEstimator.from_mesh(path, "mm", (0.2, 0.3), symmetries=None)
    assert plain.parts[0].symmetries_discrete is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"working_distance": None}, "without a working distance"),
        ({"working_distance": (0.5, 0.3)}, "working_distance"),
        ({"working_distance": (300.0, 500.0)}, "300 to 500 m and pivconnector of .* in metres"),
        ({"working_distance": (0.01, 0.02)}, "0.5 to 300 diameters .* unit of the mesh"),
        ({"tilt_deg": 200.0}, "tilt_deg"),
        ({"refine": "depth"}, "refine=depth"),
        ({"unit": "foot"}, "foot"),
        ({"name": ""}, "part name"),
    ],
)
def test_wrong_options_are_rejected(near_truth, tmp_path, options, words):
    path = tmp_path / "part.stl"
    path.write_text("")
    mesh = path if "unit" in options else "pivconnector"
    with pytest.raises(UserError, match=words):
        PoseEstimator.from_mesh(mesh, **{"working_distance": (NEAR, FAR), **options})


def test_templates_are_always_refined(estimator):
    with pytest.raises(UserError, match="refine=None"):
        estimator.refining(None)
