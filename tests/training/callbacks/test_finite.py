"""Steps that are not finite: what they leave as it was, how they count, how they end a run."""

from __future__ import annotations

import csv
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.precision import MixedPrecision
from torch import Tensor
from torch.optim.lr_scheduler import OneCycleLR
from torch.utils.data import DataLoader

from dopepp.core.errors import RunError, UserError
from dopepp.data.batch import Batch, collate
from dopepp.data.sources.rendered import RenderedSource
from dopepp.data.transforms.resize import letterbox_sample
from dopepp.parts.part import Part
from dopepp.training.callbacks.finite import FOLDER, FiniteSteps, check_state
from dopepp.training.checkpointing.files import AtomicCheckpointIO
from dopepp.training.loggers import MetricsTable
from dopepp.training.system import PoseSystem
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets.preset import PRESETS

SystemMaker = Callable[..., PoseSystem]
ROOT = Path(__file__).parents[3]
NUM_BATCHES = 4


class Faulty(PoseSystem):
    """Has one pass after the other; those listed are bad in the way that is named."""

    faults: Mapping[int, str] = {}
    passes = 0

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        loss = super().training_step(batch, batch_idx)
        fault = self.faults.get(self.passes, "")
        self.passes += 1
        if fault == "loss":
            loss = loss * torch.nan
        elif fault == "gradient":  # the root of zero is zero, its derivative is not finite
            loss = loss + (next(self.parameters()).sum() * 0).sqrt()
        elif fault == "statistics":
            next(b for b in self.buffers() if b.is_floating_point()).fill_(torch.inf)
        return loss

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        super().optimizer_step(*args, **kwargs)
        if self.faults.get(self.passes - 1) == "weights":  # as too high a rate makes them
            next(self.parameters()).data[0] = torch.nan


class States(Callback):
    """Keeps what there is to change, before the first and after every batch."""

    def __init__(self) -> None:
        self.states: list[list[Tensor]] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._keep(trainer, pl_module)

    def on_train_batch_end(  # type: ignore[override]
        self, trainer: Trainer, pl_module: LightningModule, *_: object
    ) -> None:
        self._keep(trainer, pl_module)

    def _keep(self, trainer: Trainer, pl_module: LightningModule) -> None:
        moments = [
            value
            for state in trainer.optimizers[0].state.values()
            for value in state.values()
            if isinstance(value, Tensor)
        ]
        present = [*pl_module.state_dict().values(), *moments]
        self.states.append([tensor.detach().clone() for tensor in present])

    def changed(self) -> list[bool]:
        pairs = zip(self.states, self.states[1:], strict=False)
        return [
            len(a) != len(b) or not all(torch.equal(x, y) for x, y in zip(a, b, strict=True))
            for a, b in pairs
        ]


@pytest.fixture(scope="module")
def batches(part: Part) -> list[Batch]:
    source = RenderedSource(Factory([part], PRESETS["quickstart"], seed=3), 2 * NUM_BATCHES)
    samples = [letterbox_sample(source.sample(index), (64, 64)) for index in range(len(source))]
    pairs = zip(samples[::2], samples[1::2], strict=True)
    return [collate(pair, {part.name: 0}) for pair in pairs]


class Run:
    """One epoch of four batches."""

    def __init__(
        self, system: PoseSystem, batches: list[Batch], folder: Path,
        max_in_a_row: int = 10, save_every: int = 1, **options: Any,
    ) -> None:  # fmt: skip
        self.folder, self.states, self.guard = folder, States(), FiniteSteps(max_in_a_row)
        last = ModelCheckpoint(
            folder, filename="last", every_n_train_steps=save_every, enable_version_counter=False
        )
        self.system = system
        self.trainer = Trainer(
            accelerator="cpu",
            max_epochs=1,
            default_root_dir=folder,
            logger=MetricsTable(folder / "metrics.csv"),
            callbacks=[self.guard, self.states, last],
            plugins=[AtomicCheckpointIO(), *options.pop("plugins", [])],
            use_distributed_sampler=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            num_sanity_val_steps=0,
            limit_val_batches=0,
            log_every_n_steps=1,
            **{"gradient_clip_val": 1.0, **options},
        )
        self.trainer.fit(system, DataLoader(batches, batch_size=None))

    def counts(self) -> list[str]:
        with (self.folder / "metrics.csv").open(newline="") as stream:
            return [row["train/skipped_steps"] for row in csv.DictReader(stream)]


def faulty(make_system: SystemMaker, faults: Mapping[int, str], **options: Any) -> Faulty:
    system = make_system(system_class=Faulty, **options)
    assert isinstance(system, Faulty)
    system.faults = faults
    return system


@pytest.mark.parametrize("fault", ["loss", "gradient", "statistics"])
def test_a_bad_step_changes_nothing_and_the_schedule_goes_on(
    fault: str,
    make_system: SystemMaker,
    batches: list[Batch],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def schedule(optimizer: torch.optim.Optimizer, steps: int) -> OneCycleLR:
        return OneCycleLR(optimizer, max_lr=1e-3, total_steps=steps)

    system = faulty(make_system, {1: fault}, make_scheduler=schedule)
    run = Run(system, batches, tmp_path)
    assert run.states.changed() == [True, False, True, True]
    assert run.counts() == ["0.0", "1.0", "1.0", "1.0"]
    assert (run.guard.skipped, run.guard.in_a_row) == (1, 0)
    assert run.trainer.global_step == NUM_BATCHES
    assert run.trainer.lr_scheduler_configs[0].scheduler.last_epoch == NUM_BATCHES
    said = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    expected = "gradient" if fault == "gradient" else fault
    assert [expected in line and "not finite in step 1:" in line for line in said] == [True]
    assert not (tmp_path / FOLDER).exists()
    # The count goes on in a resumed run.
    stored = torch.load(tmp_path / "last.ckpt", weights_only=True)["callbacks"]
    assert stored["FiniteSteps"] == {"skipped": 1}


@pytest.mark.parametrize(
    "make_optimizer",
    [
        partial(torch.optim.AdamW, lr=1e-3, weight_decay=0.5),
        partial(torch.optim.SGD, lr=1e-3, momentum=0.9, weight_decay=0.1),
        partial(torch.optim.RMSprop, lr=1e-3, momentum=0.9, weight_decay=0.1),
    ],
)
def test_no_optimizer_moves_by_its_momentum_or_decay(
    make_optimizer: Any, make_system: SystemMaker, batches: list[Batch], tmp_path: Path
) -> None:
    system = faulty(make_system, {2: "loss"}, make_optimizer=make_optimizer)
    run = Run(system, batches, tmp_path, gradient_clip_val=None)
    assert run.states.changed() == [True, True, False, True]


def test_with_accumulation_the_whole_step_is_left_out(
    make_system: SystemMaker, batches: list[Batch], tmp_path: Path
) -> None:
    system = faulty(make_system, {0: "loss"})
    run = Run(system, batches, tmp_path, accumulate_grad_batches=2)
    first, *_, last = run.states.states
    untouched = run.states.states[2]  # after the second pass the step would have been taken
    assert all(torch.equal(a, b) for a, b in zip(first, untouched, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(first, last[: len(first)], strict=True))
    assert (run.guard.skipped, run.trainer.global_step) == (1, 2)


@pytest.mark.parametrize(
    ("fault", "scale", "counted"),
    [("gradient", 2.0**10, 0), ("gradient", 0.5, 1), ("loss", 2.0**10, 1)],
)
def test_a_scalers_own_overflow_is_not_counted(
    fault: str, scale: float, counted: int,
    make_system: SystemMaker, batches: list[Batch], tmp_path: Path,
) -> None:  # fmt: skip
    scaler = torch.amp.GradScaler("cpu", init_scale=scale)
    precision = MixedPrecision("16-mixed", "cpu", scaler)
    run = Run(
        faulty(make_system, {1: fault}), batches, tmp_path,
        max_in_a_row=2, plugins=[precision],
    )  # fmt: skip
    assert run.guard.skipped == counted
    assert scaler.get_scale() == scale / 2  # its own answer, once
    weights = [
        [state[i] for i, name in enumerate(run.system.state_dict()) if "running" not in name]
        for state in run.states.states
    ]
    assert all(torch.equal(a, b) for a, b in zip(weights[1], weights[2], strict=True) if a.ndim > 1)
    assert not all(torch.equal(a, b) for a, b in zip(weights[2], weights[3], strict=True))
    if fault == "loss":
        assert not run.states.changed()[1]


def test_after_n_in_a_row_the_run_ends_with_the_batch_on_disk(
    make_system: SystemMaker,
    batches: list[Batch],
    tmp_path: Path,
    read_png: Callable[[Path], np.ndarray],
) -> None:
    system = faulty(make_system, {1: "loss", 2: "loss"})
    with pytest.raises(RunError) as error:
        Run(system, batches, tmp_path, max_in_a_row=2)
    folder = tmp_path / FOLDER
    assert "loss and gradient not finite in step 2 (2 steps in a row)" in str(error.value)
    assert str(error.value).endswith(str(folder))
    dumped = torch.load(folder / "step_2_rank_0.pt", weights_only=True)
    assert (dumped["step"], dumped["epoch"]) == (2, 0)
    assert np.isnan(dumped["loss"])
    third = batches[2]
    assert torch.equal(dumped["images"], third.images)
    assert torch.equal(dumped["T_cam_obj"], third.T_cam_obj)
    assert dumped["keys"] == third.keys
    sheet = read_png(folder / "step_2_rank_0.png").astype(int)
    blue, green, red = sheet[..., 0], sheet[..., 1], sheet[..., 2]
    assert ((green > 150) & (red < 100) & (blue < 100)).any()  # the true wireframe
    # What was saved after the good step is what there is.
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert all(value.isfinite().all() for value in saved["state_dict"].values())


def test_good_steps_between_bad_ones_keep_the_run_going(
    make_system: SystemMaker, batches: list[Batch], tmp_path: Path
) -> None:
    run = Run(faulty(make_system, {0: "loss", 2: "gradient"}), batches, tmp_path, max_in_a_row=2)
    assert run.guard.skipped == 2


def test_weights_that_are_not_finite_end_the_run_at_once(
    make_system: SystemMaker, batches: list[Batch], tmp_path: Path
) -> None:
    with pytest.raises(RunError, match=r"not finite in step 2 \(the weights are not finite\)"):
        Run(faulty(make_system, {1: "weights"}), batches, tmp_path, save_every=100)


def test_weights_that_are_not_finite_are_never_saved(
    make_system: SystemMaker, batches: list[Batch], tmp_path: Path
) -> None:
    """The weights break in the second step, after which a checkpoint is due."""
    with pytest.raises(RunError, match=r"^the weights not finite after step 2: nothing was saved"):
        Run(faulty(make_system, {1: "weights"}), batches, tmp_path)
    assert [path.name for path in tmp_path.glob("*.ckpt")] == ["last.ckpt"]
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert saved["global_step"] == 1
    check_state(saved)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_what_may_be_saved(value: float) -> None:
    good = {"w": torch.ones(3), "n": torch.tensor(4)}
    bad = {**good, "w": torch.tensor([1.0, value])}
    # A checkpoint's other entries may hold what they like: a best score of −∞, for one.
    check_state({"state_dict": good, "callbacks": {"best": torch.tensor(value)}})
    check_state({"state_dict": {}})
    with pytest.raises(RunError, match="the weights"):
        check_state({"state_dict": bad})
    moments = {"state": {0: {"exp_avg": bad["w"]}}, "param_groups": [{"lr": 1.0}]}
    with pytest.raises(RunError, match="the optimiser's state"):
        check_state({"state_dict": good, "optimizer_states": [moments]})


@pytest.mark.parametrize("count", [0, -1, 1.5, True, "ten"])
def test_a_count_that_means_nothing_is_refused(count: Any) -> None:
    with pytest.raises(UserError, match="max_in_a_row"):
        FiniteSteps(count)


SCRIPT = """
import sys
from pathlib import Path
import torch
from lightning.pytorch import LightningModule, Trainer
from torch.utils.data import DataLoader, TensorDataset
from dopepp.training.callbacks.finite import FiniteSteps
from dopepp.training.processes import WatchedDDP

class Line(LightningModule):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)
    def training_step(self, batch, batch_idx):
        loss = (self.layer(batch[0]) ** 2).mean()
        # Only the second process, and a gradient that is finite: the others learn it from the flag.
        if batch_idx == 1 and self.trainer.global_rank == 1:
            loss = loss.detach() * torch.inf + sum(p.sum() * 0 for p in self.parameters())
        return loss
    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)
    def on_train_batch_end(self, outputs, batch, batch_idx):
        self.seen = getattr(self, "seen", []) + [float(self.layer.weight)]

torch.manual_seed(0)
torch.set_num_threads(1)
guard = FiniteSteps()
trainer = Trainer(accelerator="cpu", devices=2, strategy=WatchedDDP(60), max_epochs=1, logger=False,
    callbacks=[guard], enable_checkpointing=False, enable_progress_bar=False,
    enable_model_summary=False, default_root_dir=sys.argv[1])
line = Line()
trainer.fit(line, DataLoader(TensorDataset(torch.ones(6, 1)), batch_size=1))
torch.save([guard.skipped, line.seen], Path(sys.argv[1]) / f"{trainer.global_rank}.pt")
"""


@pytest.mark.slow
@pytest.mark.ddp
def test_all_processes_leave_a_step_out_together(tmp_path: Path) -> None:
    script = tmp_path / "line.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    subprocess.run(
        [sys.executable, str(script), str(tmp_path)],
        check=True, env=environment, capture_output=True, timeout=120,
    )  # fmt: skip
    ranks = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in (0, 1)]
    assert ranks[0] == ranks[1]
    skipped, weights = ranks[0]
    assert skipped == 1
    assert weights[0] == weights[1] != weights[2]
