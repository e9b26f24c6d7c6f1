from types import SimpleNamespace
from typing import Any

import torch
from lightning.pytorch.callbacks import TQDMProgressBar

from dopepp.training.callbacks import throughput
from dopepp.training.callbacks.throughput import Operators, make_profiler, profile_rows


def test_time_is_left_for_the_whole_run(monkeypatch):
    monkeypatch.setattr(TQDMProgressBar, "on_train_start", lambda *_: None)
    monkeypatch.setattr(TQDMProgressBar, "get_metrics", lambda *_: {"train/loss": 1.0})
    now = [100.0]
    monkeypatch.setattr(throughput.time, "monotonic", lambda: now[0])
    trainer: Any = SimpleNamespace(global_step=50, estimated_stepping_batches=250)
    bar: Any = throughput.RunProgress()
    bar.on_train_start(trainer, None)
    assert "left" not in bar.get_metrics(trainer, None)
    # Twenty steps in a minute, of a run resumed at the 50th: 180 are left.
    trainer.global_step, now[0] = 70, 160.0
    assert bar.get_metrics(trainer, None) == {"left": "0:09:00", "train/loss": 1.0}
    trainer.global_step = 251  # resumed for less
    assert bar.get_metrics(trainer, None)["left"] == "0:00:00"


def test_the_simple_profiler_lists_what_took_longest(tmp_path):
    profiler: Any = make_profiler("simple", tmp_path)
    profiler.recorded_durations = {"step": [0.25, 0.75], "save": [0.125], "rest": [0.0]}
    assert profile_rows(profiler, limit=2) == [
        {"what": "step", "calls": "2", "s": "1.000", "ms/call": "500.00"},
        {"what": "save", "calls": "1", "s": "0.125", "ms/call": "125.00"},
    ]
    profiler.describe()
    (report,) = (tmp_path / "profile").iterdir()
    assert "step" in report.read_text()


def test_the_operators_of_training_and_validation(tmp_path):
    profiler = Operators(tmp_path / "profile")
    assert profile_rows(profiler) == []
    activities = [torch.profiler.ProfilerActivity.CPU]
    for _ in range(2):
        recording = torch.profiler.profile(activities=activities, on_trace_ready=profiler._collect)
        with recording, torch.profiler.record_function("[pl][profile]hook"):
            torch.ones(8, 8) @ torch.ones(8, 8)
    rows = {row["what"]: row for row in profile_rows(profiler, limit=100)}
    assert rows["aten::mm"]["calls"] == "2"
    assert not any("hook" in name for name in rows)
    assert "2 calls  aten::mm" in profiler.summary()
    traces = sorted(path.name for path in (tmp_path / "profile").iterdir())
    assert traces == ["trace_0.json", "trace_1.json"]
