"""Validation callbacks on true maps, some of them displaced; throughput, progress and profiles."""

import logging
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback
from lightning.pytorch.callbacks import TQDMProgressBar

from dopepp.core.files import read_csv
from dopepp.drawing.pictures import read_rgb
from dopepp.metrics.pose import PoseMetrics
from dopepp.training import throughput
from dopepp.training.pose_validation import (
    LOGGED,
    AUCCurves,
    Overlays,
    PoseMetricsCallback,
)
from dopepp.training.pruning import PrunedError, TrialReport, open_storage, raise_if_pruned
from dopepp.training.system import PoseSystem, ValidationOutput
from dopepp.training.throughput import Throughput, make_profiler, profile_rows


class Displaced(PoseSystem):
    """Returns the target maps; the first image's maps of every batch are shifted by two cells."""

    def validation_step(self, batch, batch_idx):
        belief, field = self.targets(batch)
        for maps in (belief, field):
            maps[::2] = maps[::2].roll(2, dims=-1)
        return ValidationOutput(belief.new_zeros(()), belief, field)


class Recorder(Callback):
    """Keeps the detections of the validation and the values that are logged at the end."""

    def __init__(self):
        self.detections, self.logged = [], {}

    def on_validation_batch_end(self, trainer, system, outputs, batch, *_):
        self.detections += system.recover(outputs, batch)

    def on_fit_end(self, trainer, system):
        self.logged = {name: float(value) for name, value in trainer.callback_metrics.items()}


@pytest.fixture
def validate(make_trainer, tmp_path):
    """Train one epoch; return the detections and logged values of its validation."""

    def fit(system, data):
        recorder = Recorder()
        shown = [PoseMetricsCallback(), AUCCurves(), Overlays(2), Throughput()]
        trainer = make_trainer(tmp_path, [*shown, recorder], enable_checkpointing=False)
        trainer.fit(system, datamodule=data)
        return recorder

    return fit


def test_metrics_images_and_throughput(validate, make_system, make_datamodule, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    system, data = make_system(system_class=Displaced), make_datamodule()
    recorder = validate(system, data)
    # The logged values equal PoseMetrics on the same poses and the samples' ground truth.
    metrics = PoseMetrics(system.parts)
    for index, detections in enumerate(recorder.detections):
        item = data.val_item(0, index)
        metrics.update(detections, item.instances, item.K, item.size[0])
    assert len(recorder.detections) == 3
    mean = metrics.compute()["mean"]
    assert mean.num_instances == 3
    logged = {name: recorder.logged[f"val/{name}"] for name in LOGGED}
    assert logged == pytest.approx({name: getattr(mean, name) for name in LOGGED}, rel=1e-4)
    assert 0 < logged["auc_10cm"] < 1  # otherwise the comparison has no meaning

    # The curves and their table agree with the metrics.
    assert read_rgb(tmp_path / "val_auc.png").std() > 0
    curve = read_csv(tmp_path / "val_auc.csv")
    assert curve[0]["threshold_m"] == "0"
    assert float(curve[-1]["pivconnector"]) == pytest.approx(mean.pass_10cm)
    # The sheet has green true and yellow predicted wireframes.
    sheet = read_rgb(tmp_path / "val_overlay.png").astype(int)
    red, green, blue = np.moveaxis(sheet, -1, 0)
    assert ((green > 150) & (red < 100) & (blue < 100)).any()
    assert ((green > 180) & (red > 180) & (blue < 80)).any()

    # Throughput is in the table, and logged once per epoch.
    last = read_csv(tmp_path / "metrics.csv")[-1]
    assert float(last["throughput/images_per_s"]) > 0
    assert 0 <= float(last["throughput/loader_wait"]) <= 1
    for name in ("val/auc_10cm", "val/selection"):
        assert float(last[name]) == pytest.approx(mean.auc_10cm, rel=1e-4)
    assert 0 < float(last["val/ar_mspd"]) < 1
    lines = [r.getMessage() for r in caplog.records if "images/s" in r.getMessage()]
    assert len(lines) == len({line.partition(":")[0] for line in lines}) > 0
    assert "% of the time waiting for the loader" in lines[0]


@pytest.mark.parametrize(("cache", "is_advised"), [("none", True), ("memory", False)])
def test_only_a_slow_loader_without_cache_gets_advice(cache, is_advised, caplog):
    caplog.set_level(logging.INFO)
    trainer, callback = MagicMock(is_global_zero=True, current_epoch=0), Throughput(cache)
    callback.on_train_epoch_start(trainer, MagicMock())
    callback.on_train_batch_start(trainer, MagicMock())  # all time is spent waiting
    callback.on_train_epoch_end(trainer, MagicMock())
    assert ("data.cache" in caplog.text) == is_advised


def test_a_validation_without_instances_logs_nan(validate, make_system, make_noise):
    class Blind(Displaced):
        def validation_step(self, batch, batch_idx):
            batch.object_index[:] = -1
            return super().validation_step(batch, batch_idx)

    recorder = validate(make_system(system_class=Blind), make_noise())
    assert np.isnan(recorder.logged["val/auc_10cm"])
    assert np.isnan(recorder.logged["val/selection"])
    assert "val/median_rotation_deg" not in recorder.logged


@pytest.mark.parametrize(("symmetries", "measure"), [(None, "add_01d"), (2, "add_or_s_01d")])
def test_the_bar_shows_add_s_of_a_symmetric_part(symmetries, measure, part, make_datamodule):
    turned = None if symmetries is None else np.diag([-1.0, -1.0, 1.0, 1.0])[None]
    callback, on_bar = PoseMetricsCallback(), []
    callback.metrics = PoseMetrics((replace(part, symmetries_discrete=turned),))
    item = make_datamodule().val_item(0, 0)
    callback.metrics.update([], item.instances, item.K, item.size[0])

    def log(name, value, prog_bar, rank_zero_only):
        on_bar.extend([name] if prog_bar else [])

    callback.on_validation_epoch_end(None, SimpleNamespace(log=log))
    assert on_bar == [f"val/{measure}"]


def test_the_remaining_time_is_of_the_whole_run(monkeypatch):
    monkeypatch.setattr(TQDMProgressBar, "on_train_start", lambda *_: None)
    monkeypatch.setattr(TQDMProgressBar, "get_metrics", lambda *_: {"train/loss": 1.0})
    now = [100.0]
    monkeypatch.setattr(throughput.time, "monotonic", lambda: now[0])
    trainer = SimpleNamespace(global_step=50, estimated_stepping_batches=250)
    bar = throughput.RunProgress()
    bar.on_train_start(trainer, None)
    assert "left" not in bar.get_metrics(trainer, None)
    # A run resumed at step 50 took a minute for 20 steps, so 180 steps take 9 minutes.
    trainer.global_step, now[0] = 70, 160.0
    assert bar.get_metrics(trainer, None) == {"left": "0:09:00", "train/loss": 1.0}
    trainer.global_step = 251  # resumed with fewer steps
    assert bar.get_metrics(trainer, None)["left"] == "0:00:00"


def test_the_simple_profiler_lists_the_slowest_hooks(tmp_path):
    profiler = make_profiler("simple", tmp_path)
    profiler.recorded_durations = {"step": [0.25, 0.75], "save": [0.125], "rest": [0.0]}
    assert profile_rows(profiler, limit=2) == [
        {"what": "step", "calls": "2", "s": "1.000", "ms/call": "500.00"},
        {"what": "save", "calls": "1", "s": "0.125", "ms/call": "125.00"},
    ]
    profiler.describe()
    (report,) = (tmp_path / "profile").iterdir()
    assert "step" in report.read_text()


def test_the_operators_of_a_training(make_system, make_noise, make_trainer, tmp_path):
    profiler = make_profiler("pytorch", tmp_path)
    assert profile_rows(profiler) == []
    trainer = make_trainer(tmp_path, [], profiler=profiler, enable_checkpointing=False)
    trainer.fit(make_system(), datamodule=make_noise())
    rows = {row["what"]: row for row in profile_rows(profiler, limit=1000)}
    assert int(rows["aten::conv2d"]["calls"]) > 0
    names = [path.name for path in (tmp_path / "profile").iterdir()]
    assert [name.endswith(".txt") for name in sorted(names, key=len)] == [True, False]
    assert any(name.endswith(".json") for name in names)


def test_validation_within_an_epoch_is_not_waiting_for_the_loader(monkeypatch):
    clock = iter([0.0, 1.0, 2.0, 2.0, 102.0, 103.0, 104.0])
    monkeypatch.setattr(throughput.time, "perf_counter", lambda: next(clock))
    trainer, logged = SimpleNamespace(world_size=1, is_global_zero=False), {}
    module = SimpleNamespace(log=lambda name, value, **_: logged.update({name: value}))
    callback = throughput.Throughput()
    callback.on_train_epoch_start(trainer, module)
    callback.on_train_batch_start(trainer, module)
    callback.on_train_batch_end(trainer, module, None, [0] * 4)
    callback.on_validation_start(trainer, module)
    callback.on_validation_end(trainer, module)
    callback.on_train_batch_start(trainer, module)
    callback.on_train_batch_end(trainer, module, None, [0] * 4)
    callback.on_train_epoch_end(trainer, module)
    assert logged == {"throughput/images_per_s": 2.0, "throughput/loader_wait": 0.5}


def test_all_processes_of_a_trial_take_the_decision_of_the_first(tmp_path):
    optuna, storage = pytest.importorskip("optuna"), str(tmp_path / "study.db")
    study = optuna.create_study(storage=open_storage(storage), study_name="s")
    study.ask()
    report = TrialReport(storage, "s", 0, "val/selection", True, after_trials=1, after_epochs=0)
    strategy = SimpleNamespace(broadcast=lambda _: "worse than the median")
    trainer = SimpleNamespace(
        is_global_zero=False, strategy=strategy, should_stop=False, max_epochs=4, current_epoch=0,
        callback_metrics={"val/selection": torch.tensor(0.5)}, callbacks=[report],
    )  # fmt: skip
    report.setup(trainer, None, "fit")
    report.on_validation_end(trainer, None)
    assert trainer.should_stop
    assert study.trials[0].intermediate_values == {}  # reported by the first process
    with pytest.raises(PrunedError, match="worse than the median"):
        raise_if_pruned(trainer)
