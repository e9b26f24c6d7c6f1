"""Launch files, parameters and layouts of the package name what there is."""

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


def test_what_is_shipped_names_what_there_is(estimator):
    topics = {f"/dope/{topic}" for topic, _ in AnswerFormatter(estimator.solid_parts).topics()}
    topics.add(DIAGNOSTICS[0])
    for name in ("dope.rviz", "dope.foxglove.json"):
        content = yaml.safe_load((SHARE / name).read_text())
        named = {word for word in words(content) if word.startswith("/")}
        assert len(named) >= 2
        assert {item.partition(".")[0] for item in named} <= topics
    (parameters,) = yaml.safe_load((SHARE / "dope.yaml").read_text()).values()
    WorkerSettings(**parameters["ros__parameters"])


def test_the_launch_file_starts_the_command_with_options_it_has(monkeypatch):
    """Of ``launch``, which is no wheel, what the file uses."""
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
    assert {f"<{item}>" for item in declared[:-1]} == {
        element for element in seen if element[0] == "<"
    }
    assert {one for one in seen if one.startswith("--")} <= options()


def options():
    command = typer.main.get_command(app).commands["node"]
    return {text for item in command.params for text in item.opts}


def words(content):
    """Yield every text in nested lists and mappings."""
    if isinstance(content, dict):
        content = [*content, *content.values()]
    if isinstance(content, list):
        for item in content:
            yield from words(item)
    elif isinstance(content, str):
        yield content
