"""A run that is interrupted in any hook and resumed ends like an uninterrupted run."""

import random
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint
from torch.optim.lr_scheduler import CosineAnnealingLR

from dopepp.core.errors import UserError
from dopepp.core.files import read_csv
from dopepp.data.batch import Batch
from dopepp.training.last_checkpoint import LastCheckpoint
from dopepp.training.optimizers import TRAINED, AveragedWeights
from dopepp.training.pose_validation import EarlyStop
from dopepp.training.run_checkpoints import newest_checkpoint
from dopepp.training.system import PoseSystem
from dopepp.training.throughput import Throughput

TIMES = ("throughput/images_per_s", "throughput/loader_wait")


class CutError(Exception):
    """An interruption of the run, like kill -9."""


class Noisy(PoseSystem):
    """Draws from every global generator in each step, so that a wrong state changes the weights.

    Python and NumPy draw two normal numbers at a time and keep the second for the next call.
    """

    def training_step(self, batch: Batch, batch_idx: int) -> torch.Tensor:
        numbers = [random.gauss(0, 1), np.random.randn(), float(torch.randn(()))]  # noqa: NPY002
        self.log("train/noise", sum(numbers))
        return super().training_step(batch, batch_idx) * (1 + sum(map(abs, numbers)))


class Cut(Callback):
    """Raises :class:`CutError` at the n-th call of all hooks together."""

    def __init__(self, at: int | None) -> None:
        self.at, self.calls = at, 0
        for name in (
            "on_train_batch_start", "on_before_optimizer_step", "on_train_batch_end",
            "on_validation_start", "on_validation_batch_start", "on_validation_batch_end",
            "on_validation_end", "on_train_epoch_start", "on_train_epoch_end", "on_train_end",
        ):  # fmt: skip
            setattr(self, name, self._count)

    def _count(self, *_: Any, **__: Any) -> None:
        self.calls += 1
        if self.calls == self.at:
            raise CutError


@pytest.fixture(scope="module")
def runs(make_system, make_noise, make_trainer):
    """Train in a folder, starting from its newest checkpoint if it exists."""

    def train(
        folder: Path, cut: Cut, last: LastCheckpoint | None = None,
        more: Sequence[Callback] = (), **options: Any,
    ) -> PoseSystem:  # fmt: skip
        system = make_system(system_class=Noisy, make_scheduler=CosineAnnealingLR)
        for seed in (random.seed, np.random.seed, torch.manual_seed):
            seed(4)
        best = ModelCheckpoint(filename="best", monitor="val/loss", enable_version_counter=False)
        last = last or LastCheckpoint(every_s=0, max_share=1)
        callbacks = [*more, Throughput(), LearningRateMonitor("step"), cut, best, last]
        trainer = make_trainer(folder, callbacks, **{"max_epochs": 2, **options})
        result = newest_checkpoint(folder)
        path = result and result[0]
        trainer.fit(system, datamodule=make_noise(), ckpt_path=path, weights_only=True)
        return system

    return train


def rows(folder: Path) -> list[dict[str, str]]:
    table = read_csv(folder / "metrics.csv")
    return [{k: v if k not in TIMES else str(bool(v)) for k, v in row.items()} for row in table]


def best(folder: Path) -> tuple[int, dict[str, torch.Tensor]]:
    content = torch.load(folder / "checkpoints" / "best.ckpt", weights_only=True)
    return content["global_step"], content["state_dict"]


def assert_same(state: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert state.keys() == other.keys()
    assert [name for name in state if not torch.equal(state[name], other[name])] == []


@pytest.fixture(scope="module")
def whole(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    cut = Cut(None)
    return folder, runs(folder, cut), cut.calls


def assert_ends_as(folder: Path, system: PoseSystem, cut: Path, again: PoseSystem) -> None:
    assert rows(cut) == rows(folder), cut
    assert_same(again.state_dict(), system.state_dict())
    assert best(cut)[0] == best(folder)[0]
    assert_same(best(cut)[1], best(folder)[1])


@pytest.mark.parametrize("every", [17, pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_cut_at_any_hook_ends_like_an_uncut_run(every, runs, whole, tmp_path):
    folder, system, num_calls = whole
    for at in range(1, num_calls + 1, every):
        cut = tmp_path / str(at)
        with pytest.raises(CutError):
            runs(cut, Cut(at))
        assert_ends_as(folder, system, cut, runs(cut, Cut(None)))


def test_the_interval_and_the_share_of_time_limit_saving(runs, tmp_path):
    patient, thrifty = LastCheckpoint(every_s=3600), LastCheckpoint(every_s=0, max_share=1e-6)
    for name, last in (("patient", patient), ("thrifty", thrifty)):
        with pytest.raises(CutError):
            runs(tmp_path / name, Cut(12), last)
    assert not (tmp_path / "patient" / "checkpoints" / "last.ckpt").exists()
    saved = torch.load(tmp_path / "thrifty" / "checkpoints" / "last.ckpt", weights_only=True)
    assert saved["global_step"] == 1  # the duration of saving is known from now on


def test_accumulated_gradients_are_never_split(runs, tmp_path):
    whole = runs(tmp_path / "whole", Cut(None), accumulate_grad_batches=2)
    for at in (6, 9):
        with pytest.raises(CutError):
            runs(tmp_path / str(at), Cut(at), accumulate_grad_batches=2)
        again = runs(tmp_path / str(at), Cut(None), accumulate_grad_batches=2)
        assert_ends_as(tmp_path / "whole", whole, tmp_path / str(at), again)


def validations(folder: Path) -> list[str]:
    return [row["epoch"] for row in rows(folder) if row["val/loss"]]


def test_patience_survives_a_cut(runs, tmp_path):
    def run(name: str, cut: int | None, patience: int = 1) -> PoseSystem:
        # Nothing counts as an improvement: with a patience of 1 the second validation is the last.
        stop = EarlyStop("val/loss", min_delta=1e9, patience=patience)
        return runs(tmp_path / name, Cut(cut), more=[stop], max_epochs=5)

    whole = run("whole", None)
    assert validations(tmp_path / "whole") == ["0", "1"]
    with pytest.raises(CutError):
        run("cut", 36)
    for _ in range(2):  # a run that stopped early remains stopped …
        again = run("cut", None)
        assert_ends_as(tmp_path / "whole", whole, tmp_path / "cut", again)
    run("cut", None, patience=2)  # … until the patience is larger
    assert validations(tmp_path / "cut") == ["0", "1", "2"]


class Recorder(Callback):
    """Keeps the weights before the first step and after each."""

    def __init__(self) -> None:
        self.states: list[dict[str, torch.Tensor]] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        self.states.append({k: v.clone() for k, v in pl_module.state_dict().items()})

    on_train_batch_end = on_train_start


def last_state(folder: Path, name: str) -> dict[str, torch.Tensor]:
    content = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    return dict(content[name])


def assert_average(folder: Path, states: Sequence[dict[str, torch.Tensor]]) -> None:
    """Compare the saved average with its formula."""
    expected = dict(states[0])
    for n, state in enumerate(states[1:], start=1):
        decay = min(0.3, n / (n + 9))
        for name, value in state.items():
            moving = value.is_floating_point()
            expected[name] = decay * expected[name] + (1 - decay) * value if moving else value
    result = last_state(folder, "state_dict")
    assert result.keys() == expected.keys()
    for name, value in result.items():
        torch.testing.assert_close(value, expected[name], rtol=1e-5, atol=1e-7)


@pytest.fixture(scope="module")
def averaged(runs, tmp_path_factory):
    folder, recorder = tmp_path_factory.mktemp("averaged"), Recorder()
    system = runs(folder, Cut(None), more=[AveragedWeights(0.3), recorder])
    assert_average(folder, recorder.states)
    return folder, system


def test_a_checkpoint_has_both_trained_weights_and_average(averaged, whole):
    average, trained = (last_state(averaged[0], name) for name in ("state_dict", TRAINED))
    assert_same(trained, averaged[1].state_dict())  # training continued with these weights
    assert_same(trained, whole[1].state_dict())  # as without an average
    assert any(not torch.equal(average[name], trained[name]) for name in trained)


@pytest.mark.parametrize("at", [9, 16, 36])  # between two steps, in both validations
def test_an_average_survives_a_cut_and_may_be_dropped(at, averaged, runs, whole, tmp_path):
    with pytest.raises(CutError):
        runs(tmp_path / "cut", Cut(at), more=[AveragedWeights(0.3)])
    shutil.copytree(tmp_path / "cut", tmp_path / "copy")
    again = runs(tmp_path / "cut", Cut(None), more=[AveragedWeights(0.3)])
    assert_ends_as(*averaged, tmp_path / "cut", again)
    assert_same(last_state(tmp_path / "cut", "state_dict"), last_state(averaged[0], "state_dict"))
    without = runs(tmp_path / "copy", Cut(None))
    assert_same(without.state_dict(), whole[1].state_dict())


def test_an_average_may_start_in_a_resumed_run(runs, whole, tmp_path):
    with pytest.raises(CutError):
        runs(tmp_path, Cut(9))
    begun, recorder = last_state(tmp_path, "state_dict"), Recorder()
    again = runs(tmp_path, Cut(None), more=[AveragedWeights(0.3), recorder])
    assert_same(recorder.states[0], begun)
    assert_average(tmp_path, recorder.states)
    assert_same(again.state_dict(), whole[1].state_dict())


@pytest.mark.parametrize("options", [{"every_s": -1.0}, {"max_share": 0.0}, {"max_share": 1.5}])
def test_arguments_out_of_range(options):
    with pytest.raises(UserError, match=f"{next(iter(options))}="):
        LastCheckpoint(**options)
