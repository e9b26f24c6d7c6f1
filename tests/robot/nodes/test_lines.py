"""Lines of JSON on stdout and over UDP, and wrong options."""

import json
import socket

import numpy as np
import pytest

from dopepp.geometry.camera_file import Camera
from dopepp.inference.frames.media import Images
from dopepp.robot.nodes.standalone import send_lines
from dopepp.robot.nodes.worker import Worker

MODEL = "pretrained/pivconnector"


@pytest.fixture
def intrinsics(camera):
    return ("--K", *camera.K[[0, 1, 0, 1], [0, 1, 2, 2]])


def test_lines_hold_the_poses_of_the_estimator(run, camera, intrinsics, estimator):
    done = run("node", MODEL, camera.folder, "--json", *intrinsics)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["number"] for row in lines] == [0, 1, 2]
    for line, image in zip(lines, camera.images, strict=True):
        expected = [detection.T_cam_obj for detection in estimator.predict(image, camera.K)]
        assert len(line["detections"]) == len(expected)
        for record, T in zip(line["detections"], expected, strict=True):
            np.testing.assert_allclose(record["T_cam_obj"], T, atol=1e-9)


def test_each_source_is_tracked_alone(camera, estimator, capsys):
    source = Images([camera.folder / "0.png"]), Camera(None, camera.K, (), "K")
    send_lines(Worker(estimator, track=True), [source, source])
    first, second = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert first["detections"] == second["detections"] != []
    assert second["speed_ms"]["network"] > 0  # the part is detected again


def test_each_datagram_holds_a_line(run, camera, intrinsics):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10)
        address = f"127.0.0.1:{receiver.getsockname()[1]}"
        done = run("node", MODEL, camera.folder, "--udp", address, *intrinsics)
        received = [json.loads(receiver.recv(70_000)) for _ in range(3)]
    assert [record["number"] for record in received] == [0, 1, 2]
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "no input and output"),
        (("--json", "--ros2"), "--ros2 and --json"),
        (("--json",), "--json without a source"),
        (("{images}", "--json"), "neither --K nor --camera"),
        (("{images}", "--json", "--K", 9, 9, 9, 9, "--camera", "c.yaml"), "--K and --camera"),
        (("{images}", "--udp", "nowhere", "--K", 9, 9, 9, 9), "--udp nowhere"),
        (("{images}", "--json", "--refine", "magic", "--K", 9, 9, 9, 9), "--refine magic"),
        (("{images}", "--json", "--conf", 2, "--K", 9, 9, 9, 9), "confidence=2"),
        (("{images}", "--json", "--params", "p.yaml"), "--params with --json"),
        (("{images}", "--bag", "a.bag", "--out", "b.mcap"), "--bag with"),
        (("camera", "--ros2"), "--ros2 with"),
        (("{images}", "--json", "--camera", "none.yaml"), "none.yaml"),
        (("{images}", "--json", "--topic", "/a", "--topic", "/b"), "2 topics with --json"),
        (("{images}", "--json", "--views", "rig.yaml"), "--views with one topic"),
        (("{images}", "--json", "--frame", "camera"), "--frame with --json"),
        (("{images}", "--udp", "localhost:9", "--overlay"), "--overlay with --udp"),
        (("{images}", "--json", "--name", "poses"), "--name with --json"),
    ],
)
def test_wrong_combinations_of_options_are_one_line(refused, camera, words, message):
    options = (str(word).format(images=camera.folder) for word in words)
    assert message in refused("node", MODEL, *options)
