"""Optimisers that torch does not have."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim import AdamW

_QUINTIC: Final = (3.4445, -4.7750, 2.0315)
"""Of s, s³ and s⁵: five rounds bring every singular value of 0.002–1 to 0.7–1.2 (Jordan 2024)."""

_ROUNDS: Final = 5

_RMS: Final = 0.2
"""Root mean square of AdamW's updates, in learning rates (Liu et al. 2025, Muon is scalable)."""


class Muon(AdamW):
    """Momentum made orthogonal for the weights of convolutions, AdamW for all else.

    A convolution's weight is a matrix, output channels by all the rest. Its step is the momentum
    (Nesterov's) with all singular values brought near 1 (Jordan et al. 2024), so that directions of
    small gradients are learned as fast as those of large ones; it is as large as AdamW's, and the
    same learning rates and decays serve both. Biases and norms take AdamW's step.

    Args:
        params: What to learn.
        lr: Learning rate.
        betas: Decay of the momentum (of both), and of AdamW's squares.
        eps: Added to AdamW's root mean squares.
        weight_decay: Decoupled, in learning rates.
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

    Each round is a polynomial of the small Gram matrix times the one before, and all of them
    commute, so only the first and the last product are with the matrix itself.
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
