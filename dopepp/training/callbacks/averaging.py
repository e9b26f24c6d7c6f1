"""Exponential moving average of the weights (EMA): what is validated, saved as best and measured.

Lightning's own callback is not used, because a checkpoint that it saves inside a validation has
both sets of weights the wrong way round, it ends a training by overwriting the trained weights
with the averaged ones, and it keeps the average on the CPU where training is not.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from dopepp.core.checks import check_number

TRAINED: Final = "trained_state"
"""Checkpoint entry of the weights that training goes on with; ``state_dict`` are the averaged."""
_AVERAGED: Final = "averaged_state"
"""Where a loaded checkpoint's averaged weights are handed to the callback."""

_MAX_DECAY: Final = 1 - 1e-6
_RAMP: Final = 10
"""The average spans the last ``n / _RAMP`` of n steps until the decay is reached: the untrained
weights of the beginning would otherwise count for a thousand steps and more."""


class AveragedWeights(Callback):
    """Keeps a moving average of weights and batch norm statistics, and validates with it.

    After step n, ``average += (1 − d)·(weights − average)`` with ``d = min(decay, n / (n + 9))``.
    Every checkpoint's ``state_dict`` is the average, so whatever reads a checkpoint gets it;
    training goes on with the weights under :data:`TRAINED`.

    Args:
        decay: Between 0 (no averaging) and 1: the average spans about 1 / (1 − decay) steps.

    Raises:
        UserError: The decay is out of its range.
    """

    def __init__(self, decay: float) -> None:
        self.decay = check_number("ema", decay, 0, _MAX_DECAY)
        self._num_updates = self._step = 0
        self._names: list[str] = []
        self._weights: list[Tensor] = []
        self._average: list[Tensor] = []
        self._set_aside: list[Tensor] = []
        self._loaded: dict[str, Tensor] | None = None

    def state_dict(self) -> dict[str, Any]:
        """Return how far the average is."""
        return {"num_updates": self._num_updates, "step": self._step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there."""
        self._num_updates, self._step = int(state_dict["num_updates"]), int(state_dict["step"])

    def on_load_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Take the average of a run that had one; that of another run begins with its weights."""
        self._loaded = checkpoint.get(_AVERAGED)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin with the present weights, on the device where they are by now."""
        state = pl_module.state_dict()
        self._names, self._weights = list(state), list(state.values())
        # In 32 bits whatever the weights have: in 16 a thousandth of a difference is lost.
        self._average = [
            value.float().clone() if value.is_floating_point() else value.clone()
            for value in self._weights
        ]
        if self._loaded is not None:
            for name, average in zip(self._names, self._average, strict=True):
                average.copy_(self._loaded[name])
            self._loaded = None

    @torch.no_grad()
    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Move the average, where the batch has ended a step of the optimiser."""
        if trainer.global_step == self._step:
            return
        self._step = trainer.global_step
        self._num_updates += 1
        decay = min(self.decay, self._num_updates / (self._num_updates + _RAMP - 1))
        pairs = list(zip(self._average, self._weights, strict=True))
        moving = [(a, w.float()) for a, w in pairs if w.is_floating_point()]
        torch._foreach_lerp_([a for a, _ in moving], [w for _, w in moving], 1 - decay)
        for average, weight in pairs:
            if not weight.is_floating_point():  # batch norm's counter
                average.copy_(weight)

    @torch.no_grad()
    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Put the average into the network."""
        self._set_aside = [weight.clone() for weight in self._weights]
        for average, weight in zip(self._average, self._weights, strict=True):
            weight.copy_(average)

    @torch.no_grad()
    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Put the trained weights back."""
        for trained, weight in zip(self._set_aside, self._weights, strict=True):
            weight.copy_(trained)
        self._set_aside = []

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Save both, in the middle of a validation as well."""
        trained = self._set_aside or self._weights
        checkpoint[TRAINED] = dict(zip(self._names, trained, strict=True))
        checkpoint["state_dict"] = {
            name: average.to(weight.dtype)
            for name, average, weight in zip(self._names, self._average, self._weights, strict=True)
        }


def go_on_with_trained(checkpoint: dict[str, Any]) -> None:
    """Make the trained weights of a loaded checkpoint the ones that training goes on with.

    A run that was begun with an average may go on without one, which then is dropped.

    Args:
        checkpoint: As loaded, before anything has been taken from it; is changed.
    """
    if TRAINED in checkpoint:
        checkpoint[_AVERAGED] = checkpoint["state_dict"]
        checkpoint["state_dict"] = checkpoint.pop(TRAINED)
