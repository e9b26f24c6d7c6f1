import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dopepp.core.errors import UserError
from dopepp.geometry.camera import make_transform, move_pose, project_keypoints, step_between
from dopepp.geometry.rotation import rotation_angle, rotation_vector_to_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.motion import PERSISTENCE, SUDDEN, Motion, at_rest
from dopepp.inference.tracker import CHECK_EVERY, MAX_DOUBTS, MAX_UNSEEN, PoseTracker
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.recovery.detection import Detection

K = np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]])
IMAGE = np.zeros((480, 640, 3), np.uint8)
PART = pivconnector()


class Stage:
    """A simulated estimator with known poses of parts (``actors``).

    Refinement detects a part within three standard deviations of the start pose. The network
    detects all parts except ``hidden`` and ``unknown_to_network``.
    """

    def __init__(self, *parts):
        self.parts, self.refiner = parts, True
        self.actors = {}
        self.hidden, self.unknown_to_network = set(), set()
        self.looks = self.refinements = 0
        self.agreement = self.network_agreement = 0.95
        self.min_score = 0.5

    def put(self, name, position, turn=(0.0, 0.0, 0.0), part=PART):
        self.actors[name] = part.name, move_pose(np.eye(4), np.array([*turn, *position]))

    def split(self, candidates):
        return PoseEstimator.split(self, candidates)

    def candidates(self, image, K, roi=None, cropped=False):
        self.looks += 1
        self.roi = roi
        return [
            replace(self._detection(part, pose), agreement=self.network_agreement)
            for name, (part, pose) in self.actors.items()
            if name not in self.hidden | self.unknown_to_network
        ]

    def _detection(self, part, pose):
        cuboid = next(item.cuboid for item in self.parts if item.name == part)
        keypoints = project_keypoints(cuboid, pose, K)
        return Detection(part, 0.9, 0.8, pose, keypoints, keypoints, 0.5, np.eye(6) * 1e-6)

    def refined(self, given, image, K, followed):
        assert followed
        self.refinements += len(given)
        return [self._refined(item) for item in given]

    def _refined(self, start):
        for name, (part, pose) in self.actors.items():
            if part != start.object or name in self.hidden:
                continue
            deviation = np.sqrt(np.diag(start.covariance))
            turn = rotation_angle(pose[:3, :3] @ start.T_cam_obj[:3, :3].T)
            shift = np.linalg.norm(pose[:3, 3] - start.T_cam_obj[:3, 3])
            if turn <= 3 * deviation[0] and shift <= 3 * deviation[3]:
                return replace(self._detection(part, pose), agreement=self.agreement)
        return replace(start, kept="nothing there")


@pytest.fixture
def stage():
    return Stage(pivconnector(), servoholder())


@pytest.fixture
def tracker(stage):
    """A tracker after one frame with one part."""
    stage.put("a", (0.0, 0.0, 0.3))
    tracker = PoseTracker(stage)
    assert len(tracker.track(IMAGE, K)) == 1
    return tracker


def test_better_detection_replaces_a_doubtful_track(stage, tracker):
    stage.agreement, stage.network_agreement = 0.5, 0.4
    assert not tracker.track(IMAGE, K)[0].detected
    stage.network_agreement = 0.8
    assert tracker.track(IMAGE, K)[0].detected


def test_tracked_part_needs_the_network_only_when_due(stage):
    tracker = PoseTracker(stage, detect_every=10)
    for frame in range(30):
        angle = math.radians(8) * frame
        stage.put("a", (0.1 * math.sin(angle), 0.0, 0.3), (0.0, 0.0, angle))
        (track,) = tracker.track(IMAGE, K)
        assert track.identity == 0
        assert track.detected == (frame == 0)
        assert_allclose(track.detection.T_cam_obj, stage.actors["a"][1], atol=1e-12)
    assert stage.looks == 3


def test_steady_motion_is_predicted(stage):
    tracker = PoseTracker(stage)
    for frame in range(12):
        turn = (0.0, math.radians(6) * frame, 0.0)
        stage.put("a", (0.01 * frame, 0.0, 0.3), turn)
        (track,) = tracker.track(IMAGE, K)
    assert_allclose(track.velocity[:3], (0, math.radians(6), 0), atol=math.radians(1))
    assert_allclose(track.velocity[3:], (0.01, 0, 0), atol=0.002)
    before = stage.refinements
    stage.put("a", (0.12, 0.0, 0.3), (0.0, math.radians(72), 0.0))
    tracker.track(IMAGE, K)
    assert stage.refinements == before + 1  # the first prediction was accurate enough


def test_lost_part_is_searched_and_keeps_its_identity(stage, tracker):
    stage.hidden = {"a"}
    for _ in range(7):
        assert tracker.track(IMAGE, K) == []
    assert stage.looks == 8
    stage.hidden = set()
    stage.put("a", (0.08, 0.0, 0.4), (0.0, 0.0, 2.0))
    (track,) = tracker.track(IMAGE, K)
    assert (track.identity, track.detected) == (0, True)
    assert not track.velocity.any()
    tracker.track(IMAGE, K)
    assert stage.looks == 9


def test_lost_part_is_reported_when_the_network_detects_it(stage, tracker):
    stage.put("a", (0.1, 0.0, 0.3))
    stage.network_agreement = 0.5  # as blurred edges
    (track,) = tracker.track(IMAGE, K)
    assert (track.identity, track.detected) == (0, True)


def test_only_parts_above_the_threshold_are_tracked(stage):
    stage.put("a", (0.0, 0.0, 0.3))
    stage.min_score = 0.95
    tracker = PoseTracker(stage)
    assert tracker.track(IMAGE, K) == []
    assert tracker.weaker == [0.9]
    stage.min_score = 0.5
    assert len(tracker.track(IMAGE, K)) == 1
    assert tracker.weaker == []
    stage.min_score = 0.95
    assert tracker.track(IMAGE, K) == []


def test_lost_part_is_forgotten(stage):
    tracker = PoseTracker(stage, detect_every=1_000_000)
    stage.put("a", (0.0, 0.0, 0.3))
    stage.put("b", (0.1, 0.0, 0.3), part=servoholder())
    tracker.track(IMAGE, K)
    stage.hidden = {"a"}
    for _ in range(MAX_UNSEEN + 2):
        (track,) = tracker.track(IMAGE, K)
        assert track.detection.object == "servoholder"
    assert stage.looks == MAX_UNSEEN + 2
    stage.hidden = set()
    assert [track.identity for track in tracker.track(IMAGE, K)] == [1]


def test_equal_parts_keep_their_identities_when_one_reappears(stage):
    tracker = PoseTracker(stage, detect_every=5)
    stage.put("left", (-0.1, 0.0, 0.4))
    stage.put("right", (0.1, 0.0, 0.4))

    def positions():
        tracks = tracker.track(IMAGE, K)
        return {track.identity: track.detection.T_cam_obj[0, 3] for track in tracks}

    before = positions()
    stage.hidden = {"left"}
    assert [list(positions().values()) for _ in range(4)][-1] == [0.1]
    stage.hidden = set()
    stage.put("third", (0.0, 0.1, 0.4))
    assert positions() == {**before, 2: 0.0}


def test_sudden_motion_is_tracked_without_the_network(stage, tracker):
    for _ in range(4):
        tracker.track(IMAGE, K)
    stage.unknown_to_network = {"a"}
    stage.put("a", (0.015, 0.0, 0.3), (math.radians(8), 0.0, 0.0))
    (track,) = tracker.track(IMAGE, K)
    assert not track.detected
    stage.put("a", (0.1, 0.0, 0.3))
    assert tracker.track(IMAGE, K) == []


def test_repeated_detections_elsewhere_move_the_track(stage):
    tracker = PoseTracker(stage, detect_every=5)
    stage.put("a", (0.0, 0.0, 0.3))
    tracker.track(IMAGE, K)
    true = stage.candidates
    turned = make_transform(np.diag([-1.0, -1.0, 1.0]), np.array([0.0, 0.0, 0.3]))
    stage.candidates = lambda *given, **options: [
        replace(option, T_cam_obj=turned) for option in true(*given, **options)
    ]
    detected = [tracker.track(IMAGE, K)[0].detected for _ in range(6)]
    # The detection of frame 5 disagrees, so the network also runs on frame 6.
    assert detected == [False] * 5 + [True]


def test_track_moves_only_to_a_detection_that_agrees_better(stage, tracker):
    stage.agreement = 0.84  # not enough less than usual to be in doubt
    elsewhere = make_transform(np.eye(3), np.array([0.0, 0.03, 0.3]))
    beside = replace(stage._detection("pivconnector", elsewhere), agreement=0.8)
    stage.candidates = lambda image, K, roi=None, cropped=False: [beside]
    for _ in range(2 * CHECK_EVERY):
        (track,) = tracker.track(IMAGE, K)
    assert track.detection.T_cam_obj[1, 3] == pytest.approx(0.0, abs=1e-9)
    beside = replace(beside, agreement=0.9)
    heights = [tracker.track(IMAGE, K)[0].detection.T_cam_obj[1, 3] for _ in range(CHECK_EVERY + 1)]
    assert max(heights) == pytest.approx(0.03)


def test_doubtful_part_continues_its_motion(stage):
    tracker = PoseTracker(stage)
    for frame in range(10):
        stage.put("a", (0.005 * frame, 0.0, 0.3))
        tracker.track(IMAGE, K)
    assert stage.looks == 1
    # A hand covers the part: half of the outline agrees, and the network detects nothing.
    stage.agreement, stage.unknown_to_network = 0.5, {"a"}
    stage.put("a", (0.047, 0.006, 0.3))
    for number in range(1, MAX_DOUBTS + 1):
        (track,) = tracker.track(IMAGE, K)
        position = track.detection.T_cam_obj[:3, 3]
        assert 0.045 < position[0] < 0.045 + 0.005 * number
        assert position[1] == 0.0
        # The network searches the region around the predicted part.
        x, y, width, height = stage.roi
        for corner in track.detection.keypoints:
            assert np.all((corner > (x, y)) & (corner < (x + width, y + height)))
        assert width * height < IMAGE[..., 0].size / 2
    assert stage.looks == 1 + MAX_DOUBTS
    assert tracker.track(IMAGE, K) == []
    assert stage.roi is None
    stage.agreement, stage.unknown_to_network = 0.95, set()
    (track,) = tracker.track(IMAGE, K)
    assert (track.identity, track.detected) == (0, True)


@pytest.mark.parametrize(
    ("options", "image", "refiner", "message"),
    [
        ({}, IMAGE[..., 0], True, "uint8"),
        ({"detect_every": 0}, IMAGE, True, "detect_every=0"),
        ({}, IMAGE, None, "refine='region'"),
    ],
)
def test_bad_input(options, image, refiner, message, stage):
    stage.refiner = refiner
    with pytest.raises(UserError, match=message):
        PoseTracker(stage, **options).track(image, K)


START = make_transform(rotation_vector_to_matrix(np.array([0.3, -0.2, 1.0])), [0.02, -0.01, 0.3])
NOISE = np.repeat([math.radians(0.5), 0.0005], 3)


def filtered(motion, T):
    """Update a prediction by a pose measured with NOISE, as refinement fuses the two."""
    prior, measured = np.linalg.inv(motion.pose_covariance), np.diag(1 / NOISE**2)
    covariance = np.linalg.inv(prior + measured)
    step = covariance @ measured @ step_between(motion.T_cam_obj, T)
    return motion.update(move_pose(motion.T_cam_obj, step), covariance)


def test_update_is_the_kalman_update():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(12, 12)) * np.tile(NOISE, 2)[:, None]
    forecast = Motion(START, rng.normal(size=6) * 0.01, root @ root.T, np.zeros(6))
    measured = rng.normal(size=6) * 1e-4  # small, so that turns add up
    result = filtered(forecast, move_pose(START, measured))
    H = np.eye(6, 12)
    P, R = forecast.covariance, np.diag(NOISE**2)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    assert_allclose(result.covariance, P - gain @ H @ P, atol=1e-12)
    after = gain @ measured
    assert_allclose(step_between(START, result.T_cam_obj), after[:6], atol=1e-9)
    assert_allclose(result.velocity, forecast.velocity + after[6:], atol=1e-9)


def test_filter_predicts_a_steady_motion():
    step = np.array([0, math.radians(6), 0, 0.01, 0, 0])
    motion, T = at_rest(START, np.diag(NOISE**2), START[2, 3]), START
    for _ in range(15):
        T = move_pose(T, step)
        motion = filtered(motion.predict(START[2, 3]), T)
    miss = step_between(motion.predict(START[2, 3]).T_cam_obj, move_pose(T, step))
    assert np.abs(miss[:3]).max() < math.radians(0.5)
    assert np.abs(miss[3:]).max() < 0.001


def test_filter_reduces_the_jitter_of_a_part_at_rest():
    rng = np.random.default_rng(1)
    motion, steps = at_rest(START, np.diag(NOISE**2), START[2, 3]), []
    for _ in range(80):
        after = filtered(motion.predict(START[2, 3]), move_pose(START, rng.normal(size=6) * NOISE))
        steps.append(step_between(motion.T_cam_obj, after.T_cam_obj))
        motion = after
    trembling = np.sqrt(np.mean(np.square(steps[20:]), axis=0) / 2)
    assert (trembling < 0.75 * NOISE).all(), trembling / NOISE
    assert np.linalg.eigvalsh(motion.covariance).min() > 0


@pytest.mark.parametrize("sudden", [False, True])
def test_prediction_is_slower_and_less_certain(sudden):
    motion = at_rest(START, np.diag(NOISE**2), START[2, 3])
    motion = Motion(START, np.array([0, 0, 0.02, 0.003, 0, 0]), motion.covariance, np.zeros(6))
    later = motion.predict(START[2, 3], sudden)
    assert_allclose(later.velocity, PERSISTENCE * motion.velocity)
    assert (np.diag(later.pose_covariance) > np.diag(motion.pose_covariance)).all()
    if sudden:
        least = np.repeat([SUDDEN[0], SUDDEN[1] * START[2, 3]], 3)
        assert (np.diag(later.pose_covariance) > least**2).all()
