"""A run cut at any hook and resumed ends as if it had not been; "cut" is here an exception."""

from __future__ import annotations

import csv
import logging
import random
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint

from dopepp.core.errors import UserError
from dopepp.data.batch import Batch
from dopepp.data.datamodule import PoseDataModule
from dopepp.data.sample import Instance, Sample, SourceInfo
from dopepp.parts.part import Part
from dopepp.training.callbacks.averaging import TRAINED, AveragedWeights
from dopepp.training.callbacks.pose_metrics import EarlyStop
from dopepp.training.callbacks.throughput import Throughput
from dopepp.training.checkpointing.files import AtomicCheckpointIO, newest_checkpoint
from dopepp.training.checkpointing.last import LastCheckpoint
from dopepp.training.loggers import MetricsTable
from dopepp.training.system import PoseSystem

SystemMaker = Callable[..., PoseSystem]
TIMES = ("throughput/images_per_s", "throughput/loader_wait")
SIZE = 32


class CutError(Exception):
    """The run ends here, as after kill -9."""


class Noisy(PoseSystem):
    """Draws from every global generator in each step, so that one in another state shows."""

    def training_step(self, batch: Batch, batch_idx: int) -> torch.Tensor:
        numbers = [random.random(), np.random.rand(), float(torch.rand(()))]  # noqa: NPY002
        self.log("train/noise", sum(numbers))
        return super().training_step(batch, batch_idx) * (1 + numbers[0] + numbers[1] + numbers[2])


class Cut(Callback):
    """Raises at the n-th call of any of the hooks, whichever it is."""

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


class Noise:
    """A source of pictures that are others in every epoch and cost nothing."""

    name = "noise"

    def __init__(self, num_images: int, part: Part) -> None:
        self.num_images, self.part = num_images, part

    def __len__(self) -> int:
        return self.num_images

    def sample(self, index: int, epoch: int = 0) -> Sample:
        rng = np.random.default_rng([epoch, index])
        image = rng.integers(0, 255, (SIZE, SIZE, 3), np.uint8)
        keypoints = rng.uniform(0, SIZE, (9, 2))
        return Sample(image, np.eye(3), [Instance(self.part.name, np.eye(4), keypoints)])

    def describe(self) -> list[SourceInfo]:
        return []

    def contains(self, label: str) -> bool:
        return True


def cosine(optimizer: torch.optim.Optimizer, num_steps: int) -> Any:
    return torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, num_steps)


class Runs:
    """Trains in a folder, from its newest checkpoint if there is one."""

    def __init__(self, make_system: SystemMaker, part: Part) -> None:
        self.make_system, self.part = make_system, part

    def __call__(
        self,
        folder: Path,
        cut: Cut,
        last: LastCheckpoint | None = None,
        more: Sequence[Callback] = (),
        **options: Any,
    ) -> PoseSystem:
        for seed in (random.seed, np.random.seed, torch.manual_seed):
            seed(3)
        system = self.make_system(system_class=Noisy, make_scheduler=cosine)
        for seed in (random.seed, np.random.seed, torch.manual_seed):
            seed(4)
        table = MetricsTable(folder / "metrics.csv")
        last = last or LastCheckpoint(every_s=0, max_share=1)
        best = ModelCheckpoint(
            filename="best", monitor="val/loss", enable_version_counter=False,
        )  # fmt: skip
        callbacks = [*more, Throughput(), LearningRateMonitor("step"), cut]
        options = {"max_epochs": 2, **options}
        data = [Noise(number, self.part) for number in (8, 4, 1)]
        datamodule = PoseDataModule(*data, [self.part.name], (SIZE, SIZE), batch_size=2)
        trainer = Trainer(
            accelerator="cpu", log_every_n_steps=1, default_root_dir=folder,
            logger=[table], callbacks=[*callbacks, best, last], enable_progress_bar=False,
            plugins=[AtomicCheckpointIO(prepare=table.write)], enable_model_summary=False,
            num_sanity_val_steps=0, use_distributed_sampler=False, **options,
        )  # fmt: skip
        found = newest_checkpoint(folder)
        trainer.fit(
            system, datamodule=datamodule, ckpt_path=found and found[0],
            weights_only=True,
        )  # fmt: skip
        return system


@pytest.fixture(scope="module", autouse=True)
def quiet() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("lightning.pytorch", "lightning.fabric"):
            patch.setattr(logging.getLogger(name), "level", logging.WARNING)
        yield


@pytest.fixture(scope="module")
def runs(make_system: SystemMaker, part: Part) -> Runs:
    return Runs(make_system, part)


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open(newline="") as stream:
        table = list(csv.DictReader(stream))
    return [{k: v if k not in TIMES else str(bool(v)) for k, v in row.items()} for row in table]


def best(folder: Path) -> tuple[int, dict[str, torch.Tensor]]:
    content = torch.load(folder / "checkpoints" / "best.ckpt", weights_only=True)
    return content["global_step"], content["state_dict"]


def assert_same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert one.keys() == other.keys()
    assert [name for name in one if not torch.equal(one[name], other[name])] == []


@pytest.fixture(scope="module")
def whole(runs: Runs, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PoseSystem, int]:
    folder = tmp_path_factory.mktemp("whole")
    cut = Cut(None)
    return folder, runs(folder, cut), cut.calls


def assert_ends_as(folder: Path, system: PoseSystem, cut: Path, again: PoseSystem) -> None:
    assert rows(cut) == rows(folder), cut
    assert_same(again.state_dict(), system.state_dict())
    assert best(cut)[0] == best(folder)[0]
    assert_same(best(cut)[1], best(folder)[1])


@pytest.mark.parametrize("every", [11, pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_cut_at_any_hook_ends_as_if_it_had_not_been(
    every: int, runs: Runs, whole: tuple[Path, PoseSystem, int], tmp_path: Path
) -> None:
    folder, system, num_calls = whole
    for at in range(1, num_calls + 1, every):
        cut = tmp_path / str(at)
        with pytest.raises(CutError):
            runs(cut, Cut(at))
        assert_ends_as(folder, system, cut, runs(cut, Cut(None)))


def test_a_run_cut_again_and_again(
    runs: Runs, whole: tuple[Path, PoseSystem, int], tmp_path: Path
) -> None:
    folder, system, _ = whole
    for _ in range(40):
        try:  # every life gets a few hooks further
            again = runs(tmp_path, Cut(12))
        except CutError:
            continue
        break
    assert_ends_as(folder, system, tmp_path, again)


def test_the_clock_and_the_share_of_time_decide(runs: Runs, tmp_path: Path) -> None:
    patient, thrifty = LastCheckpoint(every_s=3600), LastCheckpoint(every_s=0, max_share=1e-6)
    for name, last in (("patient", patient), ("thrifty", thrifty)):
        with pytest.raises(CutError):
            runs(tmp_path / name, Cut(12), last)
    assert not (tmp_path / "patient" / "checkpoints" / "last.ckpt").exists()
    saved = torch.load(tmp_path / "thrifty" / "checkpoints" / "last.ckpt", weights_only=True)
    assert saved["global_step"] == 1  # its duration is known from then on


@pytest.mark.slow
def test_accumulated_gradients_are_not_cut_in_two(runs: Runs, tmp_path: Path) -> None:
    whole = runs(tmp_path / "whole", Cut(None), accumulate_grad_batches=2)
    for at in (6, 9, 12):
        with pytest.raises(CutError):
            runs(tmp_path / str(at), Cut(at), accumulate_grad_batches=2)
        again = runs(tmp_path / str(at), Cut(None), accumulate_grad_batches=2)
        assert_ends_as(tmp_path / "whole", whole, tmp_path / str(at), again)


class Recorder(Callback):
    """Keeps the weights before the first step and after each."""

    def __init__(self) -> None:
        self.states: list[dict[str, torch.Tensor]] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.on_train_batch_end(trainer, pl_module)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        self.states.append({k: v.clone() for k, v in pl_module.state_dict().items()})


def last_state(folder: Path, name: str) -> dict[str, torch.Tensor]:
    content = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    return dict(content[name])


@pytest.mark.slow
def test_an_average_and_patience_outlive_cuts(runs: Runs, tmp_path: Path) -> None:
    def more() -> list[Callback]:
        # Nothing counts as an improvement: the third validation is the last one.
        patience = EarlyStop("val/loss", min_delta=1e9, patience=2)
        return [AveragedWeights(0.8), patience]

    recorder = Recorder()
    whole = runs(tmp_path / "whole", Cut(None), more=[*more(), recorder], max_epochs=6)
    assert [row["epoch"] for row in rows(tmp_path / "whole") if row["val/loss"]] == ["0", "1", "2"]
    expected = dict(recorder.states[0])
    for n, state in enumerate(recorder.states[1:], start=1):
        decay = min(0.8, n / (n + 9))
        for name, value in state.items():
            moving = value.is_floating_point()
            expected[name] = decay * expected[name] + (1 - decay) * value if moving else value
    averaged, trained = (last_state(tmp_path / "whole", name) for name in ("state_dict", TRAINED))
    assert averaged.keys() == expected.keys()
    for name, value in averaged.items():
        torch.testing.assert_close(value, expected[name], rtol=1e-5, atol=1e-7)
    assert_same(trained, whole.state_dict())  # training has gone on with them, to its end
    assert any(not torch.equal(averaged[name], trained[name]) for name in trained)
    for at in (16, 36):  # in the first validation, in the second one
        cut = tmp_path / str(at)
        with pytest.raises(CutError):
            runs(cut, Cut(at), more=more(), max_epochs=6)
        again = runs(cut, Cut(None), more=more(), max_epochs=6)
        assert_ends_as(tmp_path / "whole", whole, cut, again)
        assert_same(last_state(cut, "state_dict"), averaged)
    # What has stopped early stays so, until there is more patience.
    again = runs(cut, Cut(None), more=more(), max_epochs=6)
    assert_ends_as(tmp_path / "whole", whole, cut, again)
    patient = EarlyStop("val/loss", min_delta=1e9, patience=3)
    runs(cut, Cut(None), more=[AveragedWeights(0.8), patient], max_epochs=6)
    assert [row["epoch"] for row in rows(cut) if row["val/loss"]] == ["0", "1", "2", "3"]


@pytest.mark.slow
def test_an_average_may_begin_or_end_with_a_resume(runs: Runs, tmp_path: Path) -> None:
    whole = runs(tmp_path / "whole", Cut(None))
    for before, after in (([AveragedWeights(0.8)], []), ([], [AveragedWeights(0.8)])):
        cut = tmp_path / str(len(before))
        with pytest.raises(CutError):
            runs(cut, Cut(9), more=before)
        again = runs(cut, Cut(None), more=after)
        assert_same(again.state_dict(), whole.state_dict())


@pytest.mark.parametrize("decay", [1, -0.1, True, "much"])
def test_a_decay_out_of_its_range(decay: object) -> None:
    with pytest.raises(UserError, match="ema="):
        AveragedWeights(decay)  # type: ignore[arg-type]


@pytest.mark.parametrize("options", [{"every_s": -1.0}, {"max_share": 0.0}, {"max_share": 1.5}])
def test_arguments_out_of_range(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(options))}="):
        LastCheckpoint(**options)
