"""A run that is interrupted in any hook and resumed ends like an uninterrupted run."""

import random
import shutil

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint
from torch.optim.lr_scheduler import CosineAnnealingLR

from dopepp.core.errors import UserError
from dopepp.core.files import read_csv
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

    def training_step(self, batch, batch_idx):
        numbers = [random.gauss(0, 1), np.random.randn(), float(torch.randn(()))]  # noqa: NPY002
        self.log("train/noise", sum(numbers))
        return super().training_step(batch, batch_idx) * (1 + sum(map(abs, numbers)))


class Cut(Callback):
    """Raises :class:`CutError` at the n-th call of all hooks together."""

    def __init__(self, at):
        self.at, self.calls = at, 0
        for name in (
            "on_train_batch_start", "on_before_optimizer_step", "on_train_batch_end",
            "on_validation_start", "on_validation_batch_start", "on_validation_batch_end",
            "on_validation_end", "on_train_epoch_start", "on_train_epoch_end", "on_train_end",
        ):  # fmt: skip
            setattr(self, name, self._count)

    def _count(self, *_, **__):
        self.calls += 1
        if self.calls == self.at:
            raise CutError


@pytest.fixture(scope="module")
def runs(make_system, make_noise, make_trainer):
    """Train in a folder, starting from its newest checkpoint if it exists."""

    def train(folder, cut_at=None, last=None, more=(), **options):
        system = make_system(system_class=Noisy, make_scheduler=CosineAnnealingLR)
        for seed in (random.seed, np.random.seed, torch.manual_seed):
            seed(4)
        best = ModelCheckpoint(filename="best", monitor="val/loss", enable_version_counter=False)
        last, cut = last or LastCheckpoint(every_s=0, max_share=1), Cut(cut_at)
        callbacks = [*more, Throughput(), LearningRateMonitor("step"), cut, best, last]
        trainer = make_trainer(folder, callbacks, **{"max_epochs": 2, **options})
        result = newest_checkpoint(folder)
        path = result and result[0]
        if cut_at is None:
            trainer.fit(system, datamodule=make_noise(), ckpt_path=path, weights_only=True)
        else:
            with pytest.raises(CutError):
                trainer.fit(system, datamodule=make_noise(), ckpt_path=path, weights_only=True)
        system.num_calls = cut.calls
        return system

    return train


def rows(folder):
    table = read_csv(folder / "metrics.csv")
    return [{k: v if k not in TIMES else str(bool(v)) for k, v in row.items()} for row in table]


def saved(folder, name="last"):
    return torch.load(folder / "checkpoints" / f"{name}.ckpt", weights_only=True)


def assert_same(state, other):
    torch.testing.assert_close(dict(state), dict(other), rtol=0, atol=0)


@pytest.fixture(scope="module")
def whole(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return folder, runs(folder)


def assert_ends_as(folder, system, cut, again):
    assert rows(cut) == rows(folder), cut
    assert_same(again.state_dict(), system.state_dict())
    best, expected = saved(cut, "best"), saved(folder, "best")
    assert best["global_step"] == expected["global_step"]
    assert_same(best["state_dict"], expected["state_dict"])


@pytest.mark.parametrize("every", [17, pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_cut_at_any_hook_ends_like_an_uncut_run(every, runs, whole, tmp_path):
    for at in range(1, whole[1].num_calls + 1, every):
        runs(tmp_path / str(at), at)
        assert_ends_as(*whole, tmp_path / str(at), runs(tmp_path / str(at)))


def test_the_interval_and_the_share_of_time_limit_saving(runs, tmp_path):
    runs(tmp_path / "patient", 12, LastCheckpoint(every_s=3600))
    assert not (tmp_path / "patient" / "checkpoints" / "last.ckpt").exists()
    runs(tmp_path / "thrifty", 12, LastCheckpoint(every_s=0, max_share=1e-6))
    # The duration of saving is known after the first step.
    assert saved(tmp_path / "thrifty")["global_step"] == 1


def test_accumulated_gradients_are_never_split(runs, tmp_path):
    whole = runs(tmp_path / "whole", accumulate_grad_batches=2)
    for at in (6, 9):
        runs(tmp_path / str(at), at, accumulate_grad_batches=2)
        again = runs(tmp_path / str(at), accumulate_grad_batches=2)
        assert_ends_as(tmp_path / "whole", whole, tmp_path / str(at), again)


def validations(folder):
    return [row["epoch"] for row in rows(folder) if row["val/loss"]]


def test_patience_survives_a_cut(runs, tmp_path):
    def run(name, cut_at=None, patience=1):
        # Nothing counts as an improvement: with a patience of 1 the second validation is the last.
        stop = EarlyStop("val/loss", min_delta=1e9, patience=patience)
        return runs(tmp_path / name, cut_at, more=[stop], max_epochs=5)

    whole = run("whole")
    assert validations(tmp_path / "whole") == ["0", "1"]
    run("cut", 36)
    for _ in range(2):  # a run that stopped early remains stopped …
        assert_ends_as(tmp_path / "whole", whole, tmp_path / "cut", run("cut"))
    run("cut", patience=2)  # … until the patience is larger
    assert validations(tmp_path / "cut") == ["0", "1", "2"]


class Recorder(Callback):
    """Keeps the weights before the first step and after each."""

    def __init__(self):
        self.states = []

    def on_train_start(self, trainer, system, *_):
        self.states.append({k: v.clone() for k, v in system.state_dict().items()})

    on_train_batch_end = on_train_start


def assert_average(folder, states):
    """Compare the saved average with its formula."""
    expected = dict(states[0])
    for n, state in enumerate(states[1:], start=1):
        decay = min(0.3, n / (n + 9))
        for name, value in state.items():
            moving = value.is_floating_point()
            expected[name] = decay * expected[name] + (1 - decay) * value if moving else value
    torch.testing.assert_close(dict(saved(folder)["state_dict"]), expected, rtol=1e-5, atol=1e-7)


@pytest.fixture(scope="module")
def averaged(runs, tmp_path_factory):
    folder, recorder = tmp_path_factory.mktemp("averaged"), Recorder()
    system = runs(folder, more=[AveragedWeights(0.3), recorder])
    assert_average(folder, recorder.states)
    return folder, system


def test_a_checkpoint_has_both_trained_weights_and_average(averaged, whole):
    average, trained = (saved(averaged[0])[name] for name in ("state_dict", TRAINED))
    assert_same(trained, averaged[1].state_dict())  # training continued with these weights
    assert_same(trained, whole[1].state_dict())  # as without an average
    assert any(not torch.equal(average[name], trained[name]) for name in trained)


@pytest.mark.parametrize("at", [9, 16, 36])  # between two steps, in both validations
def test_an_average_survives_a_cut_and_may_be_dropped(at, averaged, runs, whole, tmp_path):
    runs(tmp_path / "cut", at, more=[AveragedWeights(0.3)])
    shutil.copytree(tmp_path / "cut", tmp_path / "copy")
    again = runs(tmp_path / "cut", more=[AveragedWeights(0.3)])
    assert_ends_as(*averaged, tmp_path / "cut", again)
    assert_same(saved(tmp_path / "cut")["state_dict"], saved(averaged[0])["state_dict"])
    assert_same(runs(tmp_path / "copy").state_dict(), whole[1].state_dict())


def test_an_average_may_start_in_a_resumed_run(runs, whole, tmp_path):
    runs(tmp_path, 9)
    begun, recorder = saved(tmp_path)["state_dict"], Recorder()
    again = runs(tmp_path, more=[AveragedWeights(0.3), recorder])
    assert_same(recorder.states[0], begun)
    assert_average(tmp_path, recorder.states)
    assert_same(again.state_dict(), whole[1].state_dict())


@pytest.mark.parametrize("options", [{"every_s": -1.0}, {"max_share": 0.0}, {"max_share": 1.5}])
def test_arguments_out_of_range(options):
    with pytest.raises(UserError, match=f"{next(iter(options))}="):
        LastCheckpoint(**options)
