"""Muon, an optimiser for convolutions, and the moving average of weights."""

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

TRAINED: Final = "trained_state"  # Key of the weights to train further; state_dict has the average
_AVERAGED: Final = "averaged_state"  # Key of the average in a loaded checkpoint

_RAMP: Final = 10
"""The average spans the last ``n / _RAMP`` of n steps until the decay is reached. Untrained weights
would otherwise contribute for a thousand steps."""

_QUINTIC: Final = (3.4445, -4.7750, 2.0315)
"""Coefficients of s, s³ and s⁵; five rounds map singular values of 0.002–1 to 0.7–1.2 (Jordan
2024)."""
_ROUNDS: Final = 5
_RMS: Final = 0.2  # RMS of AdamW's updates, in learning rates (Liu et al. 2025, Muon is scalable)


class Muon(AdamW):
    """Orthogonalised momentum for weights of convolutions, AdamW for biases and norms.

    The weight of a convolution is treated as a matrix, output channels by the rest. Its step is
    Nesterov's momentum with all singular values near 1 (Jordan et al. 2024), scaled to the size of
    AdamW's steps, so that learning rates and decays suit both. torch's own Muon needs torch 2.9 and
    accepts matrices only. Arguments are as in AdamW; ``betas[0]`` is also the momentum.
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
        """Run one optimiser step; return the closure's loss."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.ndim > 1 and weight.grad is not None:
                    self._step_matrix(weight, weight.grad, group)
                    weight.grad = None  # so that AdamW skips it
        super().step()
        return loss

    def _step_matrix(self, weight: nn.Parameter, gradient: Tensor, group: dict[str, Any]) -> None:
        """Update a weight in place by its weight decay and its orthogonalised momentum."""
        state = self.state[weight]
        if not state:  # AdamW's names, which it requires in a resumed run
            state |= {"step": torch.zeros(()), "exp_avg": torch.zeros_like(weight)}
        state["step"] += 1
        beta = group["betas"][0]
        momentum = state["exp_avg"].lerp_(gradient, 1 - beta)
        direction = orthogonalise(gradient.lerp(momentum, beta).flatten(1))
        size = _RMS * max(direction.shape) ** 0.5
        weight.mul_(1 - group["lr"] * group["weight_decay"])
        weight.sub_(direction.view_as(weight), alpha=group["lr"] * size)


def orthogonalise(matrix: Float[Tensor, "m n"]) -> Float[Tensor, "m n"]:
    """Return approximately U·Vᵀ of a matrix U·S·Vᵀ, with singular values of 0.7–1.2.

    All rounds but the last product are polynomials of the small Gram matrix.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return orthogonalise(matrix.T).T
    matrix = matrix / (matrix.norm() + 1e-12)
    gram = matrix @ matrix.T
    factor = whole = _polynomial(gram)
    for _ in range(_ROUNDS - 1):
        gram = factor @ factor @ gram
        factor = _polynomial(gram)
        whole = factor @ whole
    return whole @ matrix


def _polynomial(gram: Float[Tensor, "m m"]) -> Float[Tensor, "m m"]:
    """Return a·I + b·G + c·G², the factor of a round of ``orthogonalise`` for a Gram matrix G."""
    a, b, c = _QUINTIC
    identity = torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
    return a * identity + b * gram + c * (gram @ gram)


class AveragedWeights(WeightAveraging):
    """Exponential moving average of weights and batch norm statistics, used for validation.

    After step n, ``average += (1 − d)·(weights − average)`` with ``d = min(decay, n / (n + 9))``.
    The ``state_dict`` of a checkpoint is the average; training continues with the weights under
    :data:`TRAINED`.

    Lightning's ``EMAWeightAveraging`` is not sufficient. Its checkpoints of a validation swap both
    sets of weights. Its training ends with the average and cannot be resumed exactly. It averages
    16-bit weights in 16 bits, and its decay has no ramp.
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
        """Initialise the average with the weights, on the device of the training."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:
            # The initial weights count as one update. The counter is on the CPU, so that reading
            # it does not synchronise with a device.
            self._average_model.n_averaged = torch.tensor(1)

    def _move(self, averages: list[Tensor], weights: list[Tensor], _: object) -> None:
        """Update averages of one dtype in place by the formula of the class; copy integers."""
        if averages[0].is_floating_point():
            n = int(self._averaged.n_averaged)
            decay = min(self.decay, n / (n + _RAMP - 1))
            # In 32 bits, because 16 bits lose a thousandth of a difference.
            torch._foreach_lerp_(averages, [weight.float() for weight in weights], 1 - decay)
            return
        for average, weight in zip(averages, weights, strict=True):  # batch norm's counters
            average.copy_(weight)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Store the trained weights and copy the average to the network."""
        self._set_aside = {name: value.clone() for name, value in pl_module.state_dict().items()}
        self._copy_average_to_current(pl_module)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restore the trained weights in the network."""
        pl_module.load_state_dict(self._set_aside)
        self._set_aside = {}

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Keep the trained weights, because a run may be resumed for longer."""

    def state_dict(self) -> dict[str, Any]:
        """Return the average's number of updates and the step of the last update."""
        num_updates = int(self._averaged.n_averaged) - 1
        return {"num_updates": num_updates, "step": self._latest_update_step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the number of updates and the step."""
        self._averaged.n_averaged.fill_(int(state_dict["num_updates"]) + 1)
        self._latest_update_step = int(state_dict["step"])

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Store the average as ``state_dict`` and the trained weights under :data:`TRAINED`."""
        trained = self._set_aside or checkpoint["state_dict"]
        averaged = self._averaged.module.state_dict()
        checkpoint[TRAINED] = trained
        checkpoint["state_dict"] = {
            name: averaged[name].to(value.dtype) for name, value in trained.items()
        }

    def on_load_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Load the average, or start it from the weights of a run without an average."""
        self._averaged.module.load_state_dict(checkpoint.get(_AVERAGED, checkpoint["state_dict"]))


def restore_trained_weights(checkpoint: dict[str, Any]) -> None:
    """Replace averaged weights in a checkpoint's ``state_dict`` by the weights being trained."""
    if TRAINED in checkpoint:
        checkpoint[_AVERAGED] = checkpoint["state_dict"]
        checkpoint["state_dict"] = checkpoint.pop(TRAINED)
