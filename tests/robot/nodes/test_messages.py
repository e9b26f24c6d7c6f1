"""ROS messages of a node: poses, covariances and names, read by independent code."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import make_transform
from dopepp.inference.pose_result import PoseResult
from dopepp.recovery.detection import Detection
from dopepp.robot.nodes.messages import MARKER_FACES, AnswerFormatter, diagnosis
from dopepp.robot.nodes.worker import Answer


@pytest.fixture(scope="module")
def parts(estimator):
    return estimator.solid_parts


@pytest.fixture
def answer(camera, parts):
    rng = np.random.default_rng(0)
    detections = []
    nowhere = np.zeros((9, 2))
    for score in (0.9, 0.7):
        T = make_transform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
        half = rng.normal(size=(6, 6))
        estimate = T, nowhere, nowhere, 1.0, half @ half.T
        detections.append(Detection(parts[0].name, score, score, *estimate))
    result = PoseResult(camera.images[0], camera.K, detections, {}, "/camera/image_raw")
    return Answer(7 * 10**9 + 5, "camera_optical_frame", result)


def transform(pose):
    rotation = pose.get("orientation", pose.get("rotation"))
    position = pose.get("position", pose.get("translation"))
    R = Rotation.from_quat([rotation[k] for k in "xyzw"]).as_matrix()
    return make_transform(R, [position[k] for k in "xyz"])


def messages_of(answer, parts):
    """Return the messages of an answer by topic."""
    messages = AnswerFormatter(parts).messages(answer, lambda _: True)
    return {message.topic: message for message in messages}


def test_all_topics_hold_the_same_poses(answer, parts):
    messages = messages_of(answer, parts)
    name = parts[0].name
    assert list(messages) == [topic for topic, _ in AnswerFormatter(parts).topics()]
    header = {"stamp": {"sec": 7, "nanosec": 5}, "frame_id": "camera_optical_frame"}
    best, second = (detection.T_cam_obj for detection in answer.result.detections)
    assert messages[f"pose_{name}"].fields["header"] == header
    np.testing.assert_allclose(transform(messages[f"pose_{name}"].fields["pose"]), best, atol=1e-12)
    both = [transform(pose) for pose in messages[f"poses_{name}"].fields["poses"]]
    np.testing.assert_allclose(both, [best, second], atol=1e-12)
    frames = messages["/tf"].fields["transforms"]
    assert [frame["child_frame_id"] for frame in frames] == [f"{name}_0", f"{name}_1"]
    both = [transform(frame["transform"]) for frame in frames]
    np.testing.assert_allclose(both, [best, second], atol=1e-12)
    detections = messages["detections"].fields["detections"]
    assert [detection["id"] for detection in detections] == [f"{name}_0", f"{name}_1"]
    result = detections[1]["results"][0]
    assert result["hypothesis"] == {"class_id": name, "score": 0.7}
    covariance, order = answer.result.detections[1].covariance, [3, 4, 5, 0, 1, 2]
    sent = np.reshape(result["pose"]["covariance"], (6, 6))
    np.testing.assert_array_equal(sent, covariance[order][:, order])
    np.testing.assert_allclose(transform(result["pose"]["pose"]), second, atol=1e-12)


def test_boxes_and_markers_enclose_the_part(answer, parts):
    messages = messages_of(answer, parts)
    box = messages["detections"].fields["detections"][0]["bbox"]
    size = np.array([box["size"][k] for k in "xyz"])
    marker = messages["markers"].fields["markers"][1]
    points = np.array([[p[k] for k in "xyz"] for p in marker["points"].points])
    assert len(points) <= 3 * MARKER_FACES
    world = points @ transform(marker["pose"])[:3, :3].T + transform(marker["pose"])[:3, 3]
    T = transform(box["center"])
    inside = (world - T[:3, 3]) @ T[:3, :3]
    assert np.abs(inside).max(axis=0) == pytest.approx(size / 2, rel=0.03)
    # The first marker deletes the markers of the last image.
    assert messages["markers"].fields["markers"][0]["action"] == 3


def test_an_image_without_poses_is_published_on_requested_topics(answer, parts):
    empty = replace(answer, result=replace(answer.result, detections=[]))
    messages = messages_of(empty, parts)
    assert f"pose_{parts[0].name}" not in messages
    assert messages["detections"].fields["detections"] == []
    assert messages["/tf"].fields["transforms"] == []
    (message,) = AnswerFormatter(parts).messages(empty, {"/tf"}.__contains__)
    assert message.topic == "/tf"


def test_names_are_converted_for_topics_or_rejected(answer, parts):
    odd = replace(parts[0], name="part 1/ä")
    topics = [topic for topic, _ in AnswerFormatter([odd]).topics()]
    assert topics[0] == "pose_part_1__"
    with pytest.raises(UserError, match="differ in letters"):
        AnswerFormatter([odd, replace(parts[0], name="part_1_.")])


def test_a_diagnosis_warns_of_a_problem():
    fine, bad = (
        diagnosis(10**9, "dope", problem, {"rate": "3"}).fields["status"][0]
        for problem in ("", "oh")
    )
    assert (fine["level"], bad["level"], bad["message"]) == (0, 1, "oh")
