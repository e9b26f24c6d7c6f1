"""Lines of JSON on stdout and over UDP, and what the command refuses."""

import json
import socket

import numpy as np
import pytest
from typer.testing import CliRunner

from dopepp.cli import app

MODEL = "pretrained/pivconnector"


def call(*words):
    return CliRunner().invoke(app, ["node", *map(str, words)])


@pytest.fixture
def four(seen):
    return ("--K", *seen.K[[0, 1, 0, 1], [0, 1, 2, 2]])


def test_lines_are_the_estimators_poses(seen, four, estimator):
    done = call(MODEL, seen.folder, "--json", *four)
    assert done.exit_code == 0, done.output
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["number"] for row in lines] == [0, 1, 2]
    for line, image in zip(lines, seen.pictures, strict=True):
        expected = [detection.T_cam_obj for detection in estimator.predict(image, seen.K)]
        assert len(line["detections"]) == len(expected)
        for record, T in zip(line["detections"], expected, strict=True):
            np.testing.assert_allclose(record["T_cam_obj"], T, atol=1e-9)


def test_datagrams_hold_a_line_each(seen, four):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(10)
        done = call(MODEL, seen.folder, "--udp", f"127.0.0.1:{ear.getsockname()[1]}", *four)
        assert done.exit_code == 0, done.output
        heard = [json.loads(ear.recv(70_000)) for _ in range(3)]
    assert [record["number"] for record in heard] == [0, 1, 2]
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "no input and output"),
        (("--json", "--ros2"), "--ros2 and --json"),
        (("--json",), "--json without a source"),
        (("{pictures}", "--json"), "neither --K nor --camera"),
        (("{pictures}", "--json", "--K", 9, 9, 9, 9, "--camera", "c.yaml"), "--K and --camera"),
        (("{pictures}", "--udp", "nowhere", "--K", 9, 9, 9, 9), "--udp nowhere"),
        (("{pictures}", "--json", "--refine", "magic", "--K", 9, 9, 9, 9), "--refine magic"),
        (("{pictures}", "--json", "--conf", 2, "--K", 9, 9, 9, 9), "confidence=2"),
        (("{pictures}", "--json", "--params", "p.yaml"), "--params with --json"),
        (("{pictures}", "--bag", "a.bag", "--out", "b.mcap"), "--bag with"),
        (("camera", "--ros2"), "--ros2 with"),
    ],
)
def test_what_does_not_go_together_is_one_line(seen, words, said):
    done = call(MODEL, *(str(word).format(images=seen.folder) for word in words))
    assert done.exit_code == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_model_or_camera_that_is_not_there_is_one_line(seen, four, tmp_path):
    for words in (
        ("none.ckpt", seen.folder, "--json", *four),
        (MODEL, seen.folder, "--json", "--camera", tmp_path / "none.yaml"),
    ):
        done = call(*words)
        assert done.exit_code == 2
        assert "none." in done.stderr
        assert done.stderr.count("\n") == 1
