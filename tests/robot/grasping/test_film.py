"""Images of failed trials."""

from types import SimpleNamespace

import numpy as np

from dopepp.robot.grasping import film
from dopepp.robot.grasping.grasp_trial import GraspTask, PoseSource


def test_a_failure_that_does_not_happen_again_has_no_image(tmp_path, monkeypatch, caplog):
    """The repetition of each trial has a single attempt."""
    trials = SimpleNamespace(
        scene=lambda number: None, attempts=lambda scene, source: iter(["first"])
    )
    monkeypatch.setattr(film, "Trials", lambda task: trials)
    monkeypatch.setattr(film, "strip", lambda trials, attempt: np.zeros((8, 8, 3), np.uint8))
    source = PoseSource("network", "network")
    records = [
        SimpleNamespace(number=4, attempt=attempt, failure=failure, source="network")
        for attempt, failure in ((1, "collided"), (2, "not seen"))
    ]
    film.show(GraspTask(part="pivconnector", sources=(source,)), records, tmp_path, None, None)
    assert [path.name for path in tmp_path.iterdir()] == ["collided.jpg"]
    assert "no image of 'not seen': attempt 2 of trial 4 did not happen again" in caplog.text


def test_a_suffix_in_capitals_is_a_strip_too(tmp_path, monkeypatch):
    trials = SimpleNamespace(scene=lambda number: None, attempt=lambda scene, source: "first")
    monkeypatch.setattr(film, "Trials", lambda task: trials)
    monkeypatch.setattr(film, "strip", lambda trials, attempt: np.zeros((8, 8, 3), np.uint8))
    task = GraspTask(part="pivconnector", sources=(PoseSource("network", "network"),))
    film.show(task, [], tmp_path, tmp_path / "film.JPG", None)
    assert (tmp_path / "film.JPG").read_bytes()[:2] == b"\xff\xd8"
