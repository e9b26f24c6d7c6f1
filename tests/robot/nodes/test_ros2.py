"""The node of ROS 2: messages filled by their own types, and a camera in another process."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

ROOT = Path(__file__).parents[3]
SHARE = ROOT / "dopepp" / "robot" / "nodes" / "share"


def test_what_is_shipped_names_what_there_is(estimator):
    from dopepp.robot.nodes.messages import DIAGNOSTICS, Speaker
    from dopepp.robot.nodes.worker import Settings

    topics = {f"/dope/{topic}" for topic, _ in Speaker(estimator.solid_parts).topics()}
    topics.add(DIAGNOSTICS[0])
    for name in ("dope.rviz", "dope.foxglove.json"):
        content = yaml.safe_load((SHARE / name).read_text())
        named = {one for one in words(content) if one.startswith("/")}
        assert len(named) >= 2
        assert {one.partition(".")[0] for one in named} <= topics
    (parameters,) = yaml.safe_load((SHARE / "dope.yaml").read_text()).values()
    Settings(**parameters["ros__parameters"])


def test_the_launch_file_starts_the_command_with_options_it_has(monkeypatch):
    """Of ``launch``, which is no wheel, what the file uses."""
    import typer.main

    from dopepp.cli import app

    seen = []
    made = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {
            "DeclareLaunchArgument": lambda name, **_: name,
            "ExecuteProcess": lambda cmd, **_: seen.extend(cmd),
        },
        "launch.substitutions": {"LaunchConfiguration": lambda name: f"<{name}>"},
    }
    for name, content in made.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**content))
    declared = runpy.run_path(str(SHARE / "dope_launch.py"))["generate_launch_description"]()
    assert seen[:4] == ["dopepp", "node", "<model>", "--ros2"]
    assert {f"<{one}>" for one in declared[:-1]} == {one for one in seen if one[0] == "<"}
    command = typer.main.get_command(app).commands["node"]
    known = {text for one in command.params for text in one.opts}
    assert {one for one in seen if one.startswith("--")} <= known


def words(content):
    """Yield every text in nested lists and mappings."""
    if isinstance(content, dict):
        content = [*content, *content.values()]
    if isinstance(content, list):
        for one in content:
            yield from words(one)
    elif isinstance(content, str):
        yield content


def test_messages_are_filled_by_their_own_types():
    pytest.importorskip("rclpy", reason="needs the extra ros2")
    from dopepp.robot.nodes.messages import diagnosis, picture
    from dopepp.robot.nodes.ros2 import native
    from dopepp.robot.nodes.worker import Stamp

    message = diagnosis(Stamp(3, 4), "dope", "oh", {"rate": "30"})
    told = native(message.kind, message.fields)
    assert (told.header.stamp.sec, told.status[0].level) == (3, b"\x01")
    assert told.status[0].values[0].value == "30"
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    filled = native("sensor_msgs/Image", picture(image, {}))
    np.testing.assert_array_equal(np.frombuffer(filled.data, np.uint8).reshape(2, 4, 3), image)


@pytest.mark.slow
def test_no_picture_is_lost_between_two_processes_and_a_killed_node_starts_again():
    pytest.importorskip("rclpy", reason="needs the extra ros2")
    command = [sys.executable, str(ROOT / "benchmarks" / "node.py"), "--rate", "10"]
    done = subprocess.run(
        [*command, "--pictures", "50"], capture_output=True, text=True, timeout=280, check=False
    )
    assert done.returncode == 0, done.stderr
    rows = [line.split("|")[1:-1] for line in done.stdout.splitlines() if line.startswith("| 50")]
    assert len(rows) == 2
    for row in rows:
        sent, received, lost, _, answered, *_ = (float(one) for one in row)
        assert (sent, received, lost) == (50, 50, 0)
        assert answered > 0
    assert "ended with 143" in done.stdout
