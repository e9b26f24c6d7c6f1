"""The shipped launch file, parameters and viewer layouts use existing topics and options."""

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import typer.main
import yaml

from dopepp.cli import app
from dopepp.robot.nodes.messages import DIAGNOSTICS, AnswerFormatter
from dopepp.robot.nodes.worker import WorkerSettings

SHARE = Path(__file__).parents[3] / "dopepp" / "robot" / "nodes" / "share"


def test_shipped_layouts_and_parameters_name_existing_topics_and_settings(estimator):
    topics = {f"/dope/{topic}" for topic, _ in AnswerFormatter(estimator.solid_parts).topics()}
    topics.add(DIAGNOSTICS[0])
    for name in ("dope.rviz", "dope.foxglove.json"):
        content = yaml.safe_load((SHARE / name).read_text())
        named = {word for word in words(content) if word.startswith("/")}
        assert len(named) >= 2
        assert {item.partition(".")[0] for item in named} <= topics
    (parameters,) = yaml.safe_load((SHARE / "dope.yaml").read_text()).values()
    WorkerSettings(**parameters["ros__parameters"])


def test_the_launch_file_uses_existing_options(monkeypatch):
    """Replace ``launch``, which is not on PyPI, by a minimal substitute."""
    words_started = []
    substitutes = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {
            "DeclareLaunchArgument": lambda name, **_: name,
            "ExecuteProcess": lambda cmd, **_: words_started.extend(cmd),
        },
        "launch.substitutions": {"LaunchConfiguration": lambda name: f"<{name}>"},
    }
    for name, content in substitutes.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**content))
    declared = runpy.run_path(str(SHARE / "dope_launch.py"))["generate_launch_description"]()
    assert words_started[:4] == ["dopepp", "node", "<model>", "--ros2"]
    used = {element for element in words_started if element[0] == "<"}
    assert used == {f"<{item}>" for item in declared[:-1]}
    command = typer.main.get_command(app).commands["node"]
    options = {text for item in command.params for text in item.opts}
    assert {word for word in words_started if word.startswith("--")} <= options


def words(content):
    """Yield every text in nested lists and mappings."""
    if isinstance(content, dict):
        content = [*content, *content.values()]
    if isinstance(content, list):
        for item in content:
            yield from words(item)
    elif isinstance(content, str):
        yield content
