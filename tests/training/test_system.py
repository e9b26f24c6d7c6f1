from functools import partial

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.optim.lr_scheduler import CosineAnnealingLR, OneCycleLR

from dopepp.training.system import PoseSystem


def one_cycle(optimizer, num_steps):
    return OneCycleLR(optimizer, max_lr=1e-2, total_steps=num_steps)


@pytest.mark.parametrize("former", [one_cycle, CosineAnnealingLR, None])
@pytest.mark.parametrize("schedule", [one_cycle, CosineAnnealingLR])
def test_a_resumed_run_continues_a_new_schedule(
    former, schedule, make_system, make_noise, make_trainer, tmp_path
):
    """An ended or constant schedule continues, without an error and without a rate of zero."""

    class Watched(PoseSystem):
        def on_train_batch_start(self, batch, batch_idx):
            self.rates.append(self.trainer.optimizers[0].param_groups[0]["lr"])

    def run(folder, epochs, resume=None, schedule=schedule):
        adam = partial(torch.optim.Adam, lr=1e-2)
        system = make_system(system_class=Watched, make_scheduler=schedule, make_optimizer=adam)
        system.rates = []
        last = ModelCheckpoint(save_last=True, enable_version_counter=False)
        trainer = make_trainer(tmp_path / folder, [last], max_epochs=epochs)
        trainer.fit(system, datamodule=make_noise(), ckpt_path=resume, weights_only=True)
        return system.rates

    whole = run("whole", 2)
    assert len(whole) == 8
    run("part", 1, schedule=former)
    resumed = run("part", 2, tmp_path / "part" / "checkpoints" / "last.ckpt")
    assert resumed == pytest.approx(whole[4:], rel=1e-6)
