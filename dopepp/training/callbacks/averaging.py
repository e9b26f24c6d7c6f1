"""Exponential moving average of the weights (EMA): what is validated, saved as best and measured.

Lightning's callback with four differences. Its checkpoints are right inside a validation, too,
where Lightning's have both sets of weights the wrong way round. A training ends with the trained
weights, so that it can go on. The average stays in 32 bits, on the device where training is. And it
forgets the untrained weights sooner.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

from dopepp.core.checks import check_number

TRAINED: Final = "trained_state"
"""Checkpoint entry of the weights that training goes on with; ``state_dict`` are the averaged."""
_AVERAGED: Final = "averaged_state"
"""Where a loaded checkpoint's averaged weights are handed to the callback."""

_MAX_DECAY: Final = 1 - 1e-6
_RAMP: Final = 10
"""The average spans the last ``n / _RAMP`` of n steps until the decay is reached: the untrained
weights of the beginning would otherwise count for a thousand steps and more."""


class AveragedWeights(WeightAveraging):
    """Keeps a moving average of weights and batch norm statistics, and validates with it.

    After step n, ``average += (1 − d)·(weights − average)`` with ``d = min(decay, n / (n + 9))``:
    it spans about 1 / (1 − decay) steps, and a decay of 0 does not average. Every checkpoint's
    ``state_dict`` is the average, so whatever reads a checkpoint gets it; training goes on with the
    weights under :data:`TRAINED`. A decay outside of 0 to 1 is a :class:`UserError`.
    """

    def __init__(self, decay: float) -> None:
        self.decay = check_number("ema", decay, 0, _MAX_DECAY)
        super().__init__(multi_avg_fn=self._move)
        self._set_aside: dict[str, Tensor] = {}

    @property
    def _averaged(self) -> AveragedModel:
        assert self._average_model is not None, "there is no average before fit begins"
        return self._average_model

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Begin with the present weights, on the device where training will be."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:
            # The weights before the first step count as one; on the CPU, where reading it waits
            # for no device.
            self._average_model.n_averaged = torch.tensor(1)

    def _move(self, averages: list[Tensor], weights: list[Tensor], _: object) -> None:
        """Move averages, all of one type, towards the weights."""
        if averages[0].is_floating_point():
            n = int(self._averaged.n_averaged)
            decay = min(self.decay, n / (n + _RAMP - 1))
            # In 32 bits whatever the weights have: in 16 a thousandth of a difference is lost.
            torch._foreach_lerp_(averages, [weight.float() for weight in weights], 1 - decay)
            return
        for average, weight in zip(averages, weights, strict=True):  # batch norm's counters
            average.copy_(weight)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Put the average into the network."""
        self._set_aside = {name: value.clone() for name, value in pl_module.state_dict().items()}
        self._copy_average_to_current(pl_module)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Put the trained weights back."""
        pl_module.load_state_dict(self._set_aside)
        self._set_aside = {}

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Keep the trained weights: a run may be resumed for longer."""

    def state_dict(self) -> dict[str, Any]:
        """Return how far the average is."""
        num_updates = int(self._averaged.n_averaged) - 1
        return {"num_updates": num_updates, "step": self._latest_update_step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there."""
        self._averaged.n_averaged.fill_(int(state_dict["num_updates"]) + 1)
        self._latest_update_step = int(state_dict["step"])

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Save both, in the middle of a validation as well."""
        trained = self._set_aside or checkpoint["state_dict"]
        averaged = self._averaged.module.state_dict()
        checkpoint[TRAINED] = trained
        checkpoint["state_dict"] = {
            name: averaged[name].to(value.dtype) for name, value in trained.items()
        }

    def on_load_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Take the average of a run that had one; that of another run begins with its weights."""
        self._averaged.module.load_state_dict(checkpoint.get(_AVERAGED, checkpoint["state_dict"]))


def go_on_with_trained(checkpoint: dict[str, Any]) -> None:
    """Make the trained weights of a checkpoint, just loaded, those that training goes on with.

    A run that was begun with an average may go on without one, which then is dropped.
    """
    if TRAINED in checkpoint:
        checkpoint[_AVERAGED] = checkpoint["state_dict"]
        checkpoint["state_dict"] = checkpoint.pop(TRAINED)
