"""Trials: plans avoid estimated parts, the simulation decides, and equal seeds repeat a trial."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dopepp.geometry.camera import make_transform
from dopepp.robot.grasping.cell import HOME, STEP, TRAY
from dopepp.robot.grasping.execution import SPEED, Execution, _sample_path
from dopepp.robot.grasping.grasp_trial import GraspTask, PoseSource, SceneObservation, Trials
from dopepp.robot.grasping.grasps import Grasp
from dopepp.robot.grasping.planner import DISTURBING, MAX_HEIGHTS, align_with_bench
from dopepp.robot.grasping.selection import EstimatedPart


@pytest.fixture(scope="module")
def planner(trials, scene):
    return trials._planner(scene)


@pytest.fixture(scope="module")
def plan(planner, trials, scene):
    return planner.plan(scene.targets, trials.grasps, scene.joints)


@pytest.fixture(scope="module")
def attempt(trials, scene):
    return trials.attempt(scene, PoseSource("exact"))


def test_a_part_at_a_known_pose_is_caught(attempt):
    record, states = attempt.record, attempt.outcome.states
    assert (record.caught, record.recognised, record.failure, record.add_mm) == (True, True, "", 0)
    # At the end, the part hangs above its initial position on the bench.
    assert states[-1][-5] > states[0][-5] + 0.1


@pytest.mark.parametrize(
    ("shifts", "expected"),
    [
        ([[0.0, 0.05, 0.0]], (True, False, False, "wrong pose")),
        ([], (False, False, False, "not seen")),
    ],
)
def test_a_wrong_or_missing_pose_is_a_failure(trials, scene, monkeypatch, shifts, expected):
    poses = [scene.targets[0] @ make_transform(np.eye(3), shift) for shift in shifts]
    observation = SceneObservation([EstimatedPart(pose) for pose in poses], scene.joints)
    monkeypatch.setattr(trials, "_observe", lambda *_: observation)
    record = trials.attempt(scene, PoseSource("exact")).record
    assert (record.seen, record.caught, record.recognised, record.failure) == expected
    assert not shifts or record.error_mm == pytest.approx(50)


def test_a_pose_is_correct_up_to_the_symmetries_of_the_part(tmp_path):
    trimesh.creation.box((60, 40, 10)).export(tmp_path / "box.stl")
    grasp = "{point: [0, 0, 0], closing: [0, 1, 0], approach: [0, 0, -1], width: 0.04}"
    (tmp_path / "box.yaml").write_text(f"part: box\ngrasps: [{grasp}]\n")
    trials = Trials(GraspTask(str(tmp_path / "box.stl"), "mm", tmp_path / "box.yaml"))
    target = make_transform(np.eye(3), TRAY)
    calibrated = SimpleNamespace(hand_eye_mm=0.0, hand_eye_deg=0.0)
    scene = SimpleNamespace(number=0, attempt=1, parts=[0], targets=[target], calibrated=calibrated)
    observation = SceneObservation([], HOME)
    for half_turn in np.array([[-1, -1, 1], [1, -1, -1], [-1, 1, -1]]):
        estimate = target @ make_transform(np.diag(half_turn), np.zeros(3))
        record = trials._record(scene, PoseSource("exact"), observation, estimate, None)
        errors = record.add_mm, record.error_mm, record.error_deg
        assert record.recognised
        assert np.allclose(errors, 0, atol=1e-3)


class Attempts(Trials):
    """Trials of a heap of three parts whose attempts have given results."""

    def __init__(self, *results):
        self.task, self.results, self.failed = GraspTask(layout="heap"), list(results), []

    def attempt(self, scene, source, failed=()):
        failure, lifted = self.results.pop(0)
        self.failed.append(len(failed))
        record, outcome = SimpleNamespace(failure=failure), SimpleNamespace(lifted=(0,) * lifted)
        return SimpleNamespace(scene=scene, record=record, outcome=outcome, estimate=np.eye(4))

    def _look_again(self, attempt):
        scene, lifted = attempt.scene, attempt.outcome.lifted
        return SimpleNamespace(attempt=scene.attempt + 1, parts=scene.parts[len(lifted) :])


@pytest.mark.parametrize(
    ("results", "number"),
    [
        ([("", 1), ("slipped", 0), ("", 1), ("", 1), ("", 1)], 4),
        ([("", 2), ("", 1), ("", 1)], 2),
        ([("slipped", 0)] * 9, 6),
        ([("no plan", 0), ("", 1), ("no plan", 0), ("no plan", 0), ("", 1)], 4),
    ],
    ids=["empty", "two parts at once", "no attempts left", "no plan twice"],
)
def test_a_heap_is_tried_until_it_is_empty_or_attempts_are_used_up(results, number):
    trials = Attempts(*results)
    attempts = list(trials.attempts(SimpleNamespace(attempt=1, parts=[0, 1, 2]), None))
    assert len(attempts) == number
    failures = [bool(failure) for failure, _ in results[:number]]
    assert trials.failed == [sum(failures[:before]) for before in range(number)]


def test_a_trial_depends_on_the_seed_alone(trials, scene, attempt):
    trials.scene(1)  # another trial in between has no effect
    again = trials.scene(0)
    np.testing.assert_array_equal(again.image, scene.image)
    np.testing.assert_array_equal(again.T_base_cam, scene.T_base_cam)
    repeated = trials.attempt(again, PoseSource("exact"))
    np.testing.assert_array_equal(attempt.outcome.states[-1], repeated.outcome.states[-1])


def test_a_plan_descends_from_above_and_lifts(trials, plan):
    flanges = [trials.arm.flange(joints) for joints in (*plan.descent, plan.lift[-1])]
    heights = [flange[2, 3] for flange in flanges]
    assert heights[0] - heights[-2] == pytest.approx(0.06, abs=0.001)
    assert heights[-1] - heights[-2] == pytest.approx(0.12, abs=0.001)
    ends = heights[-2] - trials.gripper.reach(plan.grasp.width)
    assert 0 < ends < 0.003  # the pads' ends, above the bench


@pytest.mark.parametrize(
    ("shift", "rotation"),
    [((1.2, 0, 0), np.eye(3)), ((0, 0, -0.02), np.eye(3)), ((0, 0, 0), np.diag([1.0, -1, -1]))],
    ids=["out of reach", "inside the bench", "from below only"],
)
def test_there_is_no_plan(trials, scene, planner, shift, rotation):
    pose = make_transform(rotation, TRAY + np.array([0, 0, 0.0035]) + np.array(shift))
    front = [grasp for grasp in trials.grasps if grasp.approach[2] < -0.9]
    assert planner.plan([pose], front, scene.joints) is None


@pytest.mark.parametrize(
    ("tilt_deg", "rise", "is_aligned"),
    [(0, 0, True), (3, 0.002, True), (6, -0.003, True), (30, 0, True), (30, 0.02, False),
     (1, 0.02, False)],
)  # fmt: skip
def test_a_pose_close_to_the_bench_is_aligned_with_it(trials, tilt_deg, rise, is_aligned):
    bench = make_transform(np.eye(3), np.array([0.3, 0.1, 0.02]))
    flat = make_transform(np.eye(3), np.array([0.0, 0.5, 0.0235]))
    tilt = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix()
    estimate = make_transform(tilt, flat[:3, 3] + np.array([0.0, 0.0, rise]))
    aligned = align_with_bench(estimate, trials.layout.body.hull, bench, MAX_HEIGHTS["single"])
    if is_aligned:
        np.testing.assert_allclose(aligned[:3, 2], [0, 0, 1], atol=1e-9)
        assert aligned[2, 3] == pytest.approx(0.0235, abs=1e-9)
        assert np.linalg.norm(aligned[:2, 3] - flat[:2, 3]) < 0.001
    else:
        np.testing.assert_array_equal(aligned, estimate)


@pytest.fixture(scope="module")
def crowded(trials):
    """A planner for heaps."""
    scene = SimpleNamespace(calibrated=SimpleNamespace(knowledge=trials.robot(0)[1].knowledge))
    return Trials(replace(trials.task, layout="heap"))._planner(scene)


LOWER = make_transform(np.eye(3), TRAY + np.array([0, 0, 0.0035]))
ACROSS = [Grasp(np.zeros(3), np.array([0, 1.0, 0]), np.array([0, 0, -1.0]), 0.052)]


def test_a_plan_avoids_another_part(crowded):
    over = make_transform(np.eye(3), TRAY + np.array([0, 0.02, 0.012]))
    assert crowded.plan([LOWER], ACROSS, HOME) is not None
    assert crowded.plan([LOWER, over], ACROSS, HOME) is None


def test_closing_fingers_stay_above_a_part_that_sticks_out_below(crowded, trials):
    # The lower part is beside the open fingers, but between the closed fingers.
    above = make_transform(np.eye(3), TRAY + np.array([0, 0.004, 0.0106]))
    plan = crowded.plan([above, LOWER], ACROSS, HOME)
    ends = trials.arm.flange(plan.descent[-1])[2, 3] - trials.gripper.reach(plan.grasp.width)
    assert 0.007 < ends < 0.0106


def test_a_lift_that_moves_a_part_on_top_reduces_the_quality(crowded):
    left = [replace(ACROSS[0], point=np.array([-0.02, 0, 0]))]
    crossed = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    on_top = make_transform(crossed, TRAY + np.array([0.045, 0, 0.0107]))
    free, loaded = (crowded.plan(poses, left, HOME) for poses in ([LOWER], [LOWER, on_top]))
    assert free.quality > 0.9
    assert loaded.quality == pytest.approx(DISTURBING * free.quality, rel=0.01)


def test_a_motion_passes_its_waypoints_from_rest_to_rest(scene):
    path = scene.joints + np.array([[0] * 6, [0.3] * 6, [0.5, 0, 0, 0, 0, 0.1]])
    joints, speeds = (np.array(values) for values in zip(*_sample_path(path), strict=True))
    np.testing.assert_allclose(joints[-1], path[-1], atol=1e-9)
    assert np.abs(joints - path[1]).max(axis=1).min() < 0.01
    assert np.abs(speeds[[0, -1]]).max() < 0.05
    assert np.abs(speeds).max() < 2.5 * SPEED
    np.testing.assert_allclose(speeds.sum(axis=0) * STEP, path[-1] - path[0], atol=1e-3)


def test_a_plan_through_the_part_is_a_collision(trials, scene, plan):
    execution = Execution(scene.cell, copy(scene.start), trials.gripper, scene.robot.zero)
    outcome = execution.run(replace(plan, opening=0.0))
    assert outcome.collided
    assert outcome.times == sorted(outcome.times)
