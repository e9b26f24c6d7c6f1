"""The recording of a node's poses agrees with ``dopepp predict`` on the same images."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.robot.nodes.messages import VISION

pytest.importorskip("rosbags")
from rosbags import rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dopepp.geometry.camera import make_transform

MODEL = "pretrained/pivconnector"


@pytest.fixture(scope="module")
def messages(run, recording, tmp_path_factory):
    """Return the messages of every topic of the written recording, with their times."""
    out = tmp_path_factory.mktemp("out") / "poses.mcap"
    done = run("node", MODEL, "--bag", recording, "--out", out, "--overlay")
    assert "3 images" in done.output
    assert [path.name for path in out.parent.iterdir()] == ["poses.mcap"]
    store = get_typestore(Stores.ROS2_HUMBLE)
    for kind, text in VISION.items():
        store.register(get_types_from_msg(text, kind))
    topics = {}
    with rosbag2.Reader(out) as reader:
        for connection, at, content in reader.messages():
            message = store.deserialize_cdr(content, connection.msgtype)
            topics.setdefault(connection.topic, []).append((at, message))
    return topics


def test_poses_equal_those_of_predict(run, messages, recording):
    expected = list(map(json.loads, run("predict", MODEL, recording).stdout.splitlines()))
    sent = [message for _, message in messages["/dope/detections"]]
    result = [(found, message.header) for message in sent for found in message.detections]
    assert len(result) == len(expected) >= 2
    for (first, header), plain in zip(result, expected, strict=True):
        pose = first.results[0].pose.pose
        position, rotation = pose.position, pose.orientation
        R = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
        T = make_transform(R, [position.x, position.y, position.z])
        np.testing.assert_allclose(T, plain["T_cam_obj"], atol=1e-6)
        assert first.results[0].hypothesis.score == pytest.approx(plain["score"], abs=1e-6)
        assert header.stamp.sec == plain["time"]


def test_every_topic_has_the_stamps_of_the_images(messages):
    for topic in ("/dope/poses_pivconnector", "/dope/detections", "/tf", "/dope/markers"):
        assert [at for at, _ in messages[topic]] == [10**9, 2 * 10**9, 3 * 10**9]
    image = messages["/dope/rgb_points"][0][1]
    assert (image.encoding, image.header.frame_id) == ("rgb8", "camera_optical_frame")
    assert len(image.data) == image.height * image.step


def test_invalid_paths_are_one_line(refused, recording, tmp_path):
    for words, message in (
        (("--bag", recording), "--bag without --out"),
        (("--bag", recording, "--out", tmp_path / "x.bag"), ".mcap"),
        (("--bag", recording, "--out", recording), "the recording to read"),
        (("--bag", tmp_path / "no.mcap", "--out", tmp_path / "x.mcap"), "no.mcap"),
        (("--bag", recording, "--out", tmp_path / "x.mcap", "--topic", "/no"), "/no"),
    ):
        assert message in refused("node", MODEL, *words)
    assert not list(tmp_path.iterdir())
