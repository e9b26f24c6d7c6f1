"""Skipped steps: unchanged states, counts, and the end of a run."""

import logging
from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.precision import MixedPrecision
from torch import Tensor
from torch.optim.lr_scheduler import OneCycleLR
from torch.utils.data import DataLoader

from dopepp.core.errors import RunError
from dopepp.core.files import read_csv
from dopepp.data.batch import Batch
from dopepp.drawing.pictures import read_rgb
from dopepp.training.guards import FOLDER, FiniteSteps
from dopepp.training.run_checkpoints import AtomicCheckpointIO
from dopepp.training.system import PoseSystem, check_state

NUM_BATCHES = 4


class Faulty(PoseSystem):
    """Makes listed passes non-finite in the named way."""

    faults: Mapping[int, str] = {}
    passes = 0

    def training_step(self, batch, batch_idx):
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

    def optimizer_step(self, *args, **kwargs):
        super().optimizer_step(*args, **kwargs)
        if self.faults.get(self.passes - 1) == "weights":  # as after a too high learning rate
            next(self.parameters()).data[0] = torch.nan


class States(Callback):
    """Keeps weights, buffers and optimiser states before the first and after every batch."""

    def __init__(self):
        self.states = []

    def on_train_start(self, trainer, system, *_):
        optimizer = trainer.optimizers[0].state.values()
        values = [
            *system.state_dict().values(),
            *(x for state in optimizer for x in state.values()),
        ]
        self.states.append(
            [value.detach().clone() for value in values if isinstance(value, Tensor)]
        )

    on_train_batch_end = on_train_start

    def changed(self):
        return [not same(*pair) for pair in pairwise(self.states)]


def same(first, second):
    pairs = zip(first, second, strict=False)
    return len(first) == len(second) and all(torch.equal(a, b) for a, b in pairs)


@pytest.fixture(scope="module")
def batches(make_noise):
    """Four batches of two."""
    return list(make_noise().train_dataloader())


class Run(NamedTuple):
    """One epoch of four batches, by a system with faults."""

    system: Faulty
    trainer: Trainer
    guard: FiniteSteps
    states: States


@pytest.fixture
def run(make_system, make_trainer, batches, tmp_path):
    """Train with faults by pass; further options are the system's, then the trainer's."""

    def start(faults, system=None, max_in_a_row=10, save_every=1, plugins=(), **options):
        faulty = make_system(system_class=Faulty, **system or {})
        faulty.faults = faults
        guard, states = FiniteSteps(max_in_a_row), States()
        last = ModelCheckpoint(
            tmp_path, filename="last", every_n_train_steps=save_every, enable_version_counter=False
        )
        options = {"gradient_clip_val": 1.0, "limit_val_batches": 0} | options
        options["plugins"] = [AtomicCheckpointIO(), *plugins]
        trainer = make_trainer(tmp_path, [guard, states, last], **options)
        trainer.fit(faulty, DataLoader(batches, batch_size=None))
        return Run(faulty, trainer, guard, states)

    return start


@pytest.mark.parametrize("fault", ["loss", "gradient", "statistics"])
def test_a_bad_step_changes_nothing_but_the_schedule(fault, run, tmp_path, caplog):
    schedule = {"make_scheduler": lambda optimizer, num: OneCycleLR(optimizer, 1e-3, num)}
    done = run({1: fault}, schedule)
    assert done.states.changed() == [True, False, True, True]
    counts = [row["train/skipped_steps"] for row in read_csv(tmp_path / "metrics.csv")]
    assert counts == ["0.0", "1.0", "1.0", "1.0"]
    assert (done.guard.skipped, done.guard.in_a_row) == (1, 0)
    assert done.trainer.global_step == NUM_BATCHES
    assert done.trainer.lr_scheduler_configs[0].scheduler.last_epoch == NUM_BATCHES
    lines = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert [fault in line and "not finite in step 1:" in line for line in lines] == [True]
    assert not (tmp_path / FOLDER).exists()
    # A resumed run continues the count.
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
def test_no_optimizer_moves_by_its_momentum_or_decay(make_optimizer, run):
    faults = {0: "gradient", 2: "loss"}  # never two in a row
    done = run(faults, {"make_optimizer": make_optimizer}, max_in_a_row=2, gradient_clip_val=None)
    assert (done.states.changed(), done.guard.skipped) == ([False, True, False, True], 2)


def test_with_accumulation_the_whole_step_is_skipped(run):
    done = run({0: "loss"}, accumulate_grad_batches=2)
    first, *_, last = done.states.states
    assert same(first, done.states.states[2])  # after the second pass, which completes the step
    assert not same(first, last[: len(first)])
    assert (done.guard.skipped, done.trainer.global_step) == (1, 2)


@pytest.mark.parametrize(
    ("fault", "scale", "counted"),
    [("gradient", 2.0**10, 0), ("gradient", 0.5, 1), ("loss", 2.0**10, 1)],
)
def test_a_scalers_own_overflow_is_not_counted(fault, scale, counted, run):
    scaler = torch.amp.GradScaler("cpu", init_scale=scale)
    precision = MixedPrecision("16-mixed", "cpu", scaler)
    done = run({1: fault}, max_in_a_row=2, plugins=[precision])
    assert done.guard.skipped == counted
    assert scaler.get_scale() == scale / 2  # halved once, by the scaler
    weights = [
        [state[i] for i, name in enumerate(done.system.state_dict()) if "running" not in name]
        for state in done.states.states
    ]
    assert all(torch.equal(a, b) for a, b in zip(weights[1], weights[2], strict=True) if a.ndim > 1)
    assert not all(torch.equal(a, b) for a, b in zip(weights[2], weights[3], strict=True))
    if fault == "loss":
        assert not done.states.changed()[1]


def test_after_n_in_a_row_the_run_ends_with_the_batch_on_disk(run, batches, tmp_path):
    with pytest.raises(RunError) as error:
        run({1: "loss", 2: "loss"}, max_in_a_row=2)
    folder = tmp_path / FOLDER
    assert "loss and gradient not finite in step 2 (2 steps in a row)" in str(error.value)
    assert str(error.value).endswith(str(folder))
    dumped = torch.load(folder / "step_2_rank_0.pt", weights_only=True)
    assert (dumped["step"], dumped["epoch"]) == (2, 0)
    assert np.isnan(dumped["loss"])
    for entry in fields(Batch):
        stored, third = dumped[entry.name], getattr(batches[2], entry.name)
        assert torch.equal(stored, third) if isinstance(third, Tensor) else stored == third
    sheet = read_rgb(folder / "step_2_rank_0.png").astype(int)
    red, green, blue = np.moveaxis(sheet, -1, 0)
    assert ((green > 150) & (red < 100) & (blue < 100)).any()  # the true wireframe
    # The checkpoint is from the good step.
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert all(value.isfinite().all() for value in saved["state_dict"].values())


def test_weights_that_are_not_finite_are_never_saved(run, tmp_path):
    """Weights that break in the second step end the run, at once or at the next checkpoint."""
    with pytest.raises(RunError, match=r"not finite in step 2 \(the weights are not finite\)"):
        run({1: "weights"}, save_every=100)
    nothing_saved = r"^the weights are not finite after step 2: nothing was saved"
    with pytest.raises(RunError, match=nothing_saved):
        run({1: "weights"})
    assert [path.name for path in tmp_path.glob("*.ckpt")] == ["last.ckpt"]
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert saved["global_step"] == 1
    check_state(saved)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_only_finite_weights_and_optimiser_states_are_saved(value):
    good, bad = {"w": torch.ones(3), "n": torch.tensor(4)}, torch.tensor([1.0, value])
    # Other entries may be infinite, e.g. a best score of −∞.
    check_state({"state_dict": good, "callbacks": {"best": torch.tensor(value)}})
    check_state({"state_dict": {}})
    with pytest.raises(RunError, match="the weights"):
        check_state({"state_dict": good | {"w": bad}})
    moments = {"state": {0: {"exp_avg": bad}}, "param_groups": [{"lr": 1.0}]}
    with pytest.raises(RunError, match="the optimiser's state"):
        check_state({"state_dict": good, "optimizer_states": [moments]})


SCRIPT = """
import sys
from pathlib import Path
import torch
from lightning.pytorch import LightningModule, Trainer
from torch.utils.data import DataLoader, TensorDataset
from dopepp.training.guards import FiniteSteps
from dopepp.training.processes import WatchedDDP

class Line(LightningModule):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)
    def training_step(self, batch, batch_idx):
        loss = (self.layer(batch[0]) ** 2).mean()
        # Only the second process has the loss, and its gradient is finite.
        if batch_idx == 1 and self.trainer.global_rank == 1:
            loss = loss.detach() * torch.inf + sum(p.sum() * 0 for p in self.parameters())
        return loss
    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)
    def on_train_batch_end(self, outputs, batch, batch_idx):
        self.weights = getattr(self, "weights", []) + [float(self.layer.weight)]

torch.manual_seed(0)
torch.set_num_threads(1)
guard = FiniteSteps()
trainer = Trainer(accelerator="cpu", devices=2, strategy=WatchedDDP(60), max_epochs=1, logger=False,
    callbacks=[guard], enable_checkpointing=False, enable_progress_bar=False,
    enable_model_summary=False, default_root_dir=sys.argv[1])
line = Line()
trainer.fit(line, DataLoader(TensorDataset(torch.ones(6, 1)), batch_size=1))
torch.save([guard.skipped, line.weights], Path(sys.argv[1]) / f"{trainer.global_rank}.pt")
"""


@pytest.mark.slow
@pytest.mark.ddp
def test_all_processes_skip_a_step_together(command, tmp_path):
    (tmp_path / "line.py").write_text(SCRIPT)
    command(tmp_path / "line.py", str(tmp_path), timeout=120, code=0)
    ranks = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in (0, 1)]
    assert ranks[0] == ranks[1]
    skipped, weights = ranks[0]
    assert skipped == 1
    assert weights[0] == weights[1] != weights[2]
