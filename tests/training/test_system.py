from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.optim.lr_scheduler import CosineAnnealingLR, LRScheduler, OneCycleLR

from dopepp.data.batch import Batch
from dopepp.data.datamodule import PoseDataModule
from dopepp.geometry.camera import camera_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.training.checkpointing.files import AtomicCheckpointIO
from dopepp.training.loggers import MetricsTable
from dopepp.training.system import PoseSystem, ValidationOutput


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


def test_a_checkpoint_describes_itself_and_predicts(make_system, make_noise, tmp_path):
    system = make_system()
    fit(system, make_noise(), tmp_path)
    path = tmp_path / "checkpoints" / "best.ckpt"
    assert torch.load(path, weights_only=True)["dopepp"] == system.payload
    estimator = PoseEstimator.load(path)
    assert [part.name for part in estimator.checkpoint.parts] == ["pivconnector"]
    for name, value in system.network.state_dict().items():
        assert torch.equal(value, estimator.network.state_dict()[name]), name
    image = np.zeros((96, 128, 3), np.uint8)
    assert isinstance(estimator.predict(image, camera_matrix(110.0, 110.0, 63.5, 47.5)), list)


def one_cycle(optimizer: torch.optim.Optimizer, num_steps: int) -> LRScheduler:
    return OneCycleLR(optimizer, max_lr=1e-2, total_steps=num_steps)


def cosine(optimizer: torch.optim.Optimizer, num_steps: int) -> LRScheduler:
    return CosineAnnealingLR(optimizer, T_max=num_steps)


@pytest.mark.parametrize("schedule", [one_cycle, cosine])
def test_a_run_resumed_for_longer_follows_the_longer_schedule(
    schedule, make_system, make_noise, tmp_path
):
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
        fit(system, make_noise(), tmp_path / folder, epochs, resume)
        return system.rates

    whole = run("whole", 2)
    assert len(whole) == 8
    run("part", 1)
    resumed = run("part", 2, tmp_path / "part" / "checkpoints" / "last.ckpt")
    # The step after the restart still has the rate that the checkpoint's optimiser had, unless the
    # schedule can say it in closed form.
    skipped = 1 if schedule is one_cycle else 0
    assert resumed[skipped:] == pytest.approx(whole[4 + skipped :], rel=1e-6)


def test_recover_names_the_parts(make_system, batch, part):
    system = make_system()
    output = ValidationOutput(torch.tensor(0.0), *system.targets(batch))
    for detections, truth in zip(system.recover(output, batch), batch.T_cam_obj, strict=True):
        assert [one.object for one in detections] == [part.name]
        offset = detections[0].T_cam_obj[:3, 3] - truth[0, :3, 3].numpy()
        assert abs(offset).max() < 0.01
