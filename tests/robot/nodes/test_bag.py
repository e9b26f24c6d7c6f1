"""From a recording to a recording: the poses that ``dopepp predict`` finds on its images."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from dopepp.cli import app
from dopepp.robot.nodes.messages import VISION

pytest.importorskip("rosbags")
from rosbags import rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MODEL = "pretrained/pivconnector"


def call(*words):
    return CliRunner().invoke(app, list(map(str, words)))


@pytest.fixture(scope="module")
def answered(recording, tmp_path_factory):
    """Return every topic's messages of an answered recording."""
    out = tmp_path_factory.mktemp("out") / "poses.mcap"
    done = call("node", MODEL, "--bag", recording, "--out", out, "--overlay")
    assert done.exit_code == 0, done.output
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


def test_poses_equal_those_of_predict(answered, recording):
    done = call("predict", MODEL, recording)
    assert done.exit_code == 0, done.output
    expected = [json.loads(line) for line in done.stdout.splitlines()]
    result = [
        (detection, message.header)
        for _, message in answered["/dope/detections"]
        for detection in message.detections
    ]
    assert len(result) == len(expected) >= 2
    for (first, header), plain in zip(result, expected, strict=True):
        pose, T = first.results[0].pose.pose, np.array(plain["T_cam_obj"])
        place, turn = pose.position, pose.orientation
        np.testing.assert_allclose([place.x, place.y, place.z], T[:3, 3], atol=1e-6)
        R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        np.testing.assert_allclose(R, T[:3, :3], atol=1e-6)
        assert first.results[0].hypothesis.score == pytest.approx(plain["score"], abs=1e-6)
        assert header.stamp.sec == plain["time"]


def test_every_topic_is_stamped_as_its_picture(answered):
    for topic in ("/dope/poses_pivconnector", "/dope/detections", "/tf", "/dope/markers"):
        assert [at for at, _ in answered[topic]] == [10**9, 2 * 10**9, 3 * 10**9]
    image = answered["/dope/rgb_points"][0][1]
    assert (image.encoding, image.header.frame_id) == ("rgb8", "camera_optical_frame")
    assert len(image.data) == image.height * image.step


def test_what_cannot_be_is_one_line(recording, tmp_path):
    for words, said in (
        (("--bag", recording), "--bag without --out"),
        (("--bag", recording, "--out", tmp_path / "x.bag"), ".mcap"),
        (("--bag", recording, "--out", recording), "the recording to read"),
        (("--bag", tmp_path / "no.mcap", "--out", tmp_path / "x.mcap"), "no.mcap"),
        (("--bag", recording, "--out", tmp_path / "x.mcap", "--topic", "/no"), "/no"),
    ):
        done = call("node", MODEL, *words)
        assert done.exit_code == 2
        assert said in done.stderr
        assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
