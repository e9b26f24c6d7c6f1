"""What a node says: poses, covariances and names as ROS has them, by an independent reading."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.inference.pose_result import PoseResult
from dopepp.recovery.detection import Detection
from dopepp.robot.nodes.messages import MARKER_FACES, AnswerFormatter, diagnosis
from dopepp.robot.nodes.worker import Answer, Stamp


@pytest.fixture(scope="module")
def parts(estimator):
    return estimator.solid_parts


@pytest.fixture
def answer(seen, parts):
    rng = np.random.default_rng(0)
    found = []
    for score in (0.9, 0.7):
        T = np.eye(4)
        T[:3, :3] = Rotation.random(rng=rng).as_matrix()
        T[:3, 3] = rng.normal(size=3)
        half = rng.normal(size=(6, 6))
        found.append(Detection(parts[0].name, score, score, T, np.zeros((9, 2)),
                               np.zeros((9, 2)), 1.0, half @ half.T))  # fmt: skip
    result = PoseResult(seen.pictures[0], seen.K, found, {}, "/camera/image_raw")
    return Answer(Stamp(7, 5), "camera_optical_frame", result)


def transform(pose):
    T = np.eye(4)
    turn = pose.get("orientation", pose.get("rotation"))
    at = pose.get("position", pose.get("translation"))
    T[:3, :3] = Rotation.from_quat([turn[k] for k in "xyzw"]).as_matrix()
    T[:3, 3] = [at[k] for k in "xyz"]
    return T


def test_all_topics_tell_the_same_poses(answer, parts):
    said = {one.topic: one for one in AnswerFormatter(parts).messages(answer, lambda _: True)}
    name = parts[0].name
    assert [one.topic for one in said.values()] == [
        name for name, _ in AnswerFormatter(parts).topics()
    ]
    header = {"stamp": {"sec": 7, "nanosec": 5}, "frame_id": "camera_optical_frame"}
    best, second = (one.T_cam_obj for one in answer.result.detections)
    assert said[f"pose_{name}"].fields["header"] == header
    np.testing.assert_allclose(transform(said[f"pose_{name}"].fields["pose"]), best, atol=1e-12)
    both = [transform(one) for one in said[f"poses_{name}"].fields["poses"]]
    np.testing.assert_allclose(both, [best, second], atol=1e-12)
    frames = said["/tf"].fields["transforms"]
    assert [one["child_frame_id"] for one in frames] == [f"{name}_0", f"{name}_1"]
    np.testing.assert_allclose(
        [transform(one["transform"]) for one in frames], [best, second], atol=1e-12
    )
    detections = said["detections"].fields["detections"]
    assert [one["id"] for one in detections] == [f"{name}_0", f"{name}_1"]
    result = detections[1]["results"][0]
    assert result["hypothesis"] == {"class_id": name, "score": 0.7}
    np.testing.assert_allclose(transform(result["pose"]["pose"]), second, atol=1e-12)


def test_covariances_are_of_shift_and_turn_in_this_order(answer, parts):
    one = answer.result.detections[0]
    (said,) = (
        m
        for m in AnswerFormatter(parts).messages(answer, lambda _: True)
        if m.topic == "detections"
    )
    numbers = said.fields["detections"][0]["results"][0]["pose"]["covariance"]
    ros = np.reshape(numbers, (6, 6))
    np.testing.assert_array_equal(ros[:3, :3], one.covariance[3:, 3:])
    np.testing.assert_array_equal(ros[3:, 3:], one.covariance[:3, :3])
    np.testing.assert_array_equal(ros[:3, 3:], one.covariance[3:, :3])


def test_boxes_and_markers_enclose_the_part(answer, parts):
    said = {one.topic: one for one in AnswerFormatter(parts).messages(answer, lambda _: True)}
    box = said["detections"].fields["detections"][0]["bbox"]
    size = np.array([box["size"][k] for k in "xyz"])
    marker = said["markers"].fields["markers"][1]
    points = np.array([[p[k] for k in "xyz"] for p in marker["points"].points])
    assert len(points) <= 3 * MARKER_FACES
    world = points @ transform(marker["pose"])[:3, :3].T + transform(marker["pose"])[:3, 3]
    T = transform(box["center"])
    inside = (world - T[:3, 3]) @ T[:3, :3]
    assert np.abs(inside).max(axis=0) == pytest.approx(size / 2, rel=0.03)
    # Those of the last image go first.
    assert said["markers"].fields["markers"][0]["action"] == 3


def test_nothing_found_is_said_too_and_only_what_is_wanted(answer, parts):
    empty = replace(answer, result=replace(answer.result, detections=[]))
    said = {one.topic: one.fields for one in AnswerFormatter(parts).messages(empty, lambda _: True)}
    assert f"pose_{parts[0].name}" not in said
    assert said["detections"]["detections"] == []
    assert said["/tf"]["transforms"] == []
    assert [one.topic for one in AnswerFormatter(parts).messages(empty, {"/tf"}.__contains__)] == [
        "/tf"
    ]


def test_names_are_made_fit_for_topics_or_refused(answer, parts):
    odd = replace(parts[0], name="part 1/ä")
    topics = [topic for topic, _ in AnswerFormatter([odd]).topics()]
    assert topics[0] == "pose_part_1__"
    with pytest.raises(UserError, match="differ in letters"):
        AnswerFormatter([odd, replace(parts[0], name="part_1_.")])


def test_a_diagnosis_warns_of_trouble():
    fine, bad = (diagnosis(Stamp(1, 2), "dope", trouble, {"rate": "3"}) for trouble in ("", "oh"))
    assert fine.fields["status"][0]["level"] == 0
    assert (bad.fields["status"][0]["level"], bad.fields["status"][0]["message"]) == (1, "oh")
