"""What moves the weights: optimisers that torch does not have, and the weights' moving average."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Final

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor, nn
from torch.optim import AdamW
from torch.optim.swa_utils import AveragedModel

from dopepp.core.validation import Range, check

TRAINED: Final = "trained_state"
"""Entry of the weights that training goes on with; ``state_dict`` is the average."""

_AVERAGED: Final = "averaged_state"  # Entry of a loaded checkpoint's averaged weights

_RAMP: Final = 10
"""The average spans the last ``n / _RAMP`` of n steps until the decay is reached: the untrained
weights of the beginning would otherwise count for a thousand steps and more."""

_QUINTIC: Final = (3.4445, -4.7750, 2.0315)
"""Of s, s³ and s⁵: five rounds bring every singular value of 0.002–1 to 0.7–1.2 (Jordan 2024)."""

_ROUNDS: Final = 5

_RMS: Final = 0.2
"""Root mean square of AdamW's updates, in learning rates (Liu et al. 2025, Muon is scalable)."""


class Muon(AdamW):
    """Momentum made orthogonal for the weights of convolutions, AdamW for all else.

    A convolution's weight is a matrix, output channels by all the rest. Its step is Nesterov's
    momentum with all singular values brought near 1 (Jordan et al. 2024), so that directions of
    small gradients are learned as fast as those of large ones; it is as large as AdamW's, so
    learning rates and decays serve both. Biases and norms take AdamW's step. torch's own Muon needs
    torch 2.9 and takes matrices only. The arguments are those of AdamW; the first of ``betas`` is
    also the momentum's.
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.95, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 1e-2,
    ) -> None:
        super().__init__(params, lr, betas, eps, weight_decay)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Take one step; return the closure's loss."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.ndim > 1 and weight.grad is not None:
                    self._step_matrix(weight, weight.grad, group)
                    weight.grad = None  # so that AdamW leaves it alone
        super().step()
        return loss

    def _step_matrix(self, weight: nn.Parameter, gradient: Tensor, group: dict[str, Any]) -> None:
        """Take the step of one matrix."""
        state = self.state[weight]
        if not state:  # under AdamW's names, which it looks for when a run is resumed
            state |= {"step": torch.zeros(()), "exp_avg": torch.zeros_like(weight)}
        state["step"] += 1
        beta = group["betas"][0]
        momentum = state["exp_avg"].lerp_(gradient, 1 - beta)
        direction = orthogonalised(gradient.lerp(momentum, beta).flatten(1))
        size = _RMS * max(direction.shape) ** 0.5
        weight.mul_(1 - group["lr"] * group["weight_decay"])
        weight.sub_(direction.view_as(weight), alpha=group["lr"] * size)


def orthogonalised(matrix: Float[Tensor, "m n"]) -> Float[Tensor, "m n"]:
    """Return U·Vᵀ of a matrix U·S·Vᵀ, nearly: the singular values are 0.7–1.2.

    All rounds are polynomials of the small Gram matrix, so only the first and the last product are
    with the matrix itself.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return orthogonalised(matrix.T).T
    matrix = matrix / (matrix.norm() + 1e-12)
    gram = matrix @ matrix.T
    now = whole = _polynomial(gram)
    for _ in range(_ROUNDS - 1):
        gram = now @ now @ gram
        now = _polynomial(gram)
        whole = now @ whole
    return whole @ matrix


def _polynomial(gram: Float[Tensor, "m m"]) -> Float[Tensor, "m m"]:
    """Return what a round multiplies a matrix of this Gram matrix by."""
    a, b, c = _QUINTIC
    one = torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
    return a * one + b * gram + c * (gram @ gram)


class AveragedWeights(WeightAveraging):
    """Exponential moving average of weights and batch norm statistics, used for validation.

    After step n, ``average += (1 − d)·(weights − average)`` with ``d = min(decay, n / (n + 9))``.
    The ``state_dict`` of every checkpoint is the average; training goes on with the weights under
    :data:`TRAINED`.

    Lightning's ``EMAWeightAveraging`` does not suffice: its checkpoints of a validation have both
    sets of weights the wrong way round, its training ends with the average, so that it cannot be
    resumed exactly, it averages 16-bit weights in 16 bits, and its decay has no ramp.
    """

    def __init__(self, decay: float) -> None:
        self.decay = check("ema", decay, float, Range(0, 1 - 1e-6))
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
        """Return the average's number of updates and the step of the last one."""
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
    """Make the trained weights of a loaded checkpoint those that training goes on with."""
    if TRAINED in checkpoint:
        checkpoint[_AVERAGED] = checkpoint["state_dict"]
        checkpoint["state_dict"] = checkpoint.pop(TRAINED)
