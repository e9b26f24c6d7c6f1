from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.optim.lr_scheduler import CosineAnnealingLR, LRScheduler, OneCycleLR

from dopepp.data.batch import PADDING, Batch
from dopepp.data.datamodule import PoseDataModule
from dopepp.inference.estimator import PoseEstimator
from dopepp.parts.part import Part
from dopepp.training.checkpointing.files import AtomicCheckpointIO
from dopepp.training.loggers import MetricsTable
from dopepp.training.system import PoseSystem, ValidationOutput

SystemMaker = Callable[..., PoseSystem]


def test_targets_have_the_stride_and_a_peak_per_keypoint(
    make_system: SystemMaker, batch: Batch
) -> None:
    belief, field = make_system().targets(batch)
    assert belief.shape == (2, 9, 16, 16)
    assert field.shape == (2, 16, 16, 16)
    inside = ((batch.keypoints[:, 0] >= 0) & (batch.keypoints[:, 0] <= 127)).all(-1)
    assert (belief.amax((2, 3))[inside] > 0.7).all()
    # The largest cell is the one that holds the keypoint.
    cell = (batch.keypoints[:, 0] + 0.5).div(8, rounding_mode="floor")
    peak = belief.flatten(2).argmax(2)
    expected = cell[..., 1] * 16 + cell[..., 0]
    assert torch.equal(peak[inside], expected[inside].long())


def test_hardly_visible_instances_and_padding_leave_empty_channels(
    make_system: SystemMaker, batch: Batch
) -> None:
    system = make_system()
    hidden = replace(batch, visible_fraction=torch.tensor([[0.0999], [0.1001]]))
    belief, field = system.targets(hidden)
    assert belief[0].abs().sum() == 0
    assert field[0].abs().sum() == 0
    assert belief[1].max() > 0.7
    padded = replace(batch, object_index=torch.full_like(batch.object_index, PADDING))
    assert system.targets(padded)[0].abs().sum() == 0


def test_an_instance_fills_its_own_objects_channels_only(
    make_system: SystemMaker, batch: Batch
) -> None:
    system = make_system(num_objects=2)
    second = replace(batch, object_index=torch.tensor([[0], [1]]))
    belief, field = system.targets(second)
    assert belief.shape[1] == 18
    assert [bool(belief[row, 9 * c : 9 * c + 9].any()) for row in (0, 1) for c in (0, 1)] == [
        True, False, False, True,
    ]  # fmt: skip
    assert not field[0, 16:].any()
    assert not field[1, :16].any()


def test_the_loss_falls_on_a_fixed_batch(make_system: SystemMaker, batch: Batch) -> None:
    system = make_system()
    targets = system.targets(batch)
    optimizer = system.make_optimizer(system.network.parameters())
    losses = []
    for _ in range(40):
        optimizer.zero_grad()
        loss, terms = system.loss(system(batch.images), *targets)
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.75 * losses[0]
    assert all(torch.isfinite(term) for term in terms.values())


def fit(
    system: PoseSystem,
    data: PoseDataModule,
    folder: Path,
    max_epochs: int = 1,
    resume: Path | None = None,
) -> Trainer:
    trainer = Trainer(
        accelerator="cpu",
        max_epochs=max_epochs,
        default_root_dir=folder,
        logger=[MetricsTable(folder / "metrics.csv")],
        callbacks=[ModelCheckpoint(filename="best", save_last=True, enable_version_counter=False)],
        plugins=[AtomicCheckpointIO()],
        use_distributed_sampler=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=1,
    )
    trainer.fit(system, datamodule=data, ckpt_path=resume, weights_only=True)
    return trainer


def test_a_checkpoint_describes_itself_and_predicts(
    make_system: SystemMaker, make_datamodule: Callable[[], PoseDataModule], tmp_path: Path
) -> None:
    system, data = make_system(), make_datamodule()
    fit(system, data, tmp_path)
    path = tmp_path / "checkpoints" / "best.ckpt"
    content = torch.load(path, weights_only=True)
    assert content["dopepp"] == system.payload
    assert content["dopepp"]["parts"][0]["name"] == "pivconnector"

    estimator = PoseEstimator.load(path)
    for name, value in system.network.state_dict().items():
        assert torch.equal(value, estimator.network.state_dict()[name]), name
    sample = data.test_source.sample(0)
    assert isinstance(estimator.predict(sample.image, sample.K), list)


def one_cycle(optimizer: torch.optim.Optimizer, num_steps: int) -> LRScheduler:
    return OneCycleLR(optimizer, max_lr=1e-2, total_steps=num_steps)


def cosine(optimizer: torch.optim.Optimizer, num_steps: int) -> LRScheduler:
    return CosineAnnealingLR(optimizer, T_max=num_steps)


@pytest.mark.parametrize("schedule", [one_cycle, pytest.param(cosine, marks=pytest.mark.slow)])
def test_a_run_resumed_for_longer_follows_the_longer_schedule(
    schedule: Callable[[torch.optim.Optimizer, int], LRScheduler],
    make_system: SystemMaker,
    make_datamodule: Callable[[], PoseDataModule],
    tmp_path: Path,
) -> None:
    """A schedule that had ended neither fails nor stays at a learning rate of zero."""

    class Watched(PoseSystem):
        rates: list[float]

        def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
            self.rates.append(self.trainer.optimizers[0].param_groups[0]["lr"])

    def run(folder: str, epochs: int, resume: Path | None = None) -> list[float]:
        adam = partial(torch.optim.Adam, lr=1e-2)
        system = make_system(system_class=Watched, make_scheduler=schedule, make_optimizer=adam)
        assert isinstance(system, Watched)
        system.rates = []
        fit(system, make_datamodule(), tmp_path / folder, epochs, resume)
        return system.rates

    whole = run("whole", 2)
    assert len(whole) == 8
    run("part", 1)
    resumed = run("part", 2, tmp_path / "part" / "checkpoints" / "last.ckpt")
    # The step after the restart still has the rate that the checkpoint's optimiser had, unless the
    # schedule can say it in closed form.
    skipped = 1 if schedule is one_cycle else 0
    assert resumed[skipped:] == pytest.approx(whole[4 + skipped :], rel=1e-6)


def test_recover_names_the_parts(make_system: SystemMaker, batch: Batch, part: Part) -> None:
    system = make_system().eval()
    with torch.no_grad():
        logits, field = system(batch.images)[-1]
    belief, target_field = system.targets(batch)
    output = ValidationOutput(torch.tensor(0.0), belief, target_field)
    assert logits.shape == belief.shape
    assert field.shape == target_field.shape
    for detections, truth in zip(system.recover(output, batch), batch.T_cam_obj, strict=True):
        assert [one.object for one in detections] == [part.name]
        offset = detections[0].T_cam_obj[:3, 3] - truth[0, :3, 3].numpy()
        assert abs(offset).max() < 0.01
