"""Losses on the maps of all stages; each names the belief activation that it requires.

To add a loss, write a subclass of :class:`MapLoss` in this module and a YAML file in
``conf/model/loss``.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dopepp.core.validation import Range, check
from dopepp.models.heads import Beliefs, Fields, Stage


class MapLoss(nn.Module, ABC):
    """A loss summed over the stages; the network must use its belief ``activation``."""

    activation: ClassVar[str]

    @abstractmethod
    def parts(
        self, logits: Beliefs, field: Fields, belief_target: Beliefs, field_target: Fields
    ) -> dict[str, Float[Tensor, "batch"]]:
        """Return the weighted terms of one stage per image; the loss is the mean of their sums.

        The method is also called under ``torch.vmap``, so it must not
        branch on values, index by a mask or write into tensors in place.
        """

    def forward(
        self, stages: Sequence[Stage], belief_target: Beliefs, field_target: Fields
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """Return the loss and its detached terms, each summed over the stages.

        Loss and terms are float32 also under autocast: sums of exponentials need the precision.
        """
        summed: dict[str, Tensor] = {}
        with torch.autocast(belief_target.device.type, enabled=False):
            for logits, field in stages:
                parts = self.parts(
                    logits.float(), field.float(), belief_target.float(), field_target.float()
                )
                for name, value in parts.items():
                    summed[name] = summed[name] + value if name in summed else value
        terms = {name: value.mean() for name, value in summed.items()}
        total = torch.stack(list(terms.values())).sum()
        return total, {name: value.detach() for name, value in terms.items()}

    @torch.no_grad()
    def per_image(
        self, stages: Sequence[Stage], belief_target: Beliefs, field_target: Fields
    ) -> Float[Tensor, "batch"]:
        """Return the loss of each image alone, to choose among equally valid targets."""

        def alone(stages: Sequence[Stage], *targets: Tensor) -> Tensor:
            pairs = [(logits[None], field[None]) for logits, field in stages]
            return self.forward(pairs, *(target[None] for target in targets))[0]  # without hooks

        return torch.vmap(alone)(list(stages), belief_target, field_target)  # type: ignore[no-any-return]


class MapMSE(MapLoss):
    """DOPE's loss: the sum of the mean squared errors of belief maps and vector fields."""

    activation = "identity"

    def parts(
        self, logits: Beliefs, field: Fields, belief_target: Beliefs, field_target: Fields
    ) -> dict[str, Float[Tensor, "batch"]]:
        """Return the ``belief`` and ``field`` terms of one stage per image."""
        return {
            "belief": (logits - belief_target).square().mean(dim=(1, 2, 3)),
            "field": (field - field_target).square().mean(dim=(1, 2, 3)),
        }


_WEIGHTS: Final = Range(0, 1e6)

_LINEAR_FROM: Final = 2.0
"""Logarithm of the excess mass (e² ≈ 7) beyond which the exponential continues as its tangent, so
that gradients stay bounded."""


class SpatialCrossEntropy(MapLoss):
    r"""Poisson divergence of belief maps, split into position and mass, and L1 loss of the field.

    The belief is exp(z). Its Poisson (generalised Kullback–Leibler) divergence from a target g,
    Σ exp(z) − g·z − g + g·log g, splits exactly, with N = Σg and Λ = Σexp(z), into

    - *where*: N · KL(g/N ‖ softmax(z)), and
    - *how much*: Λ − N − N·log(Λ/N).

    Both terms are divided by the mass 2πσ² of one Gaussian: a visible keypoint weighs about 1, a
    keypoint cut off by the border less, and an absent keypoint contributes only Λ. MSE on sparse
    maps starts on a plateau, because an all-zero map has a small error. The *where* term depends
    only on the distribution of beliefs over cells, so it has a gradient from the first step.

    Args:
        sigma: Standard deviation of the target's Gaussians, cells.
        count_weight: Weight of the *how much* term.
        field_weight: Weight of the field's term: smooth L1 per cell inside the keypoints' discs.
            The field is undefined outside the discs.
    """

    activation = "exp"

    def __init__(self, sigma: float, count_weight: float = 1.0, field_weight: float = 1.0) -> None:
        super().__init__()
        # At σ = 0.1 a Gaussian is one cell; at 100 it is wider than any map.
        self.mass = 2 * math.pi * check("sigma", sigma, float, Range(0.1, 100)) ** 2
        self.count_weight = check("count_weight", count_weight, float, _WEIGHTS)
        self.field_weight = check("field_weight", field_weight, float, _WEIGHTS)

    def parts(
        self, logits: Beliefs, field: Fields, belief_target: Beliefs, field_target: Fields
    ) -> dict[str, Float[Tensor, "batch"]]:
        """Return the ``where``, ``count`` and ``field`` terms of one stage per image."""
        z, g = logits.flatten(2), belief_target.flatten(2)
        # The unit of both terms is one Gaussian's mass; in this unit, `count` is N and `log_total`
        # is log Λ.
        share = g / self.mass
        count = share.sum(-1)
        log_total = z.logsumexp(-1) - math.log(self.mass)
        # N·KL = Σ s·log(s/N) − Σ s·(z − log Λ), with s·log s = 0 at s = 0.
        log_softmax = z.log_softmax(-1)
        where = torch.xlogy(share, share).sum(-1) - torch.xlogy(count, count)
        where = where - (share * log_softmax).sum(-1)
        how_much = _capped_exp(log_total, count) - count + torch.xlogy(count, count)
        how_much = how_much - count * log_total
        return {
            "where": where.mean(dim=1),
            "count": self.count_weight * how_much.mean(dim=1),
            "field": self.field_weight * _field_error(field, field_target),
        }


def _capped_exp(value: Tensor, count: Tensor) -> Tensor:
    """Return exp(value), continued as its tangent beyond e² times the expected count (≥ 1)."""
    limit = count.clamp(min=1.0).log() + _LINEAR_FROM
    excess = (value - limit).clamp(min=0.0)
    return torch.minimum(value, limit).exp() * (1 + excess)


def _field_error(field: Tensor, target: Tensor) -> Tensor:
    """Return the smooth L1 error of the field per image, over cells with a target vector.

    Dividing by the mean number of cells makes the mean over images equal to the mean over cells.
    """
    corners = (field.shape[0], field.shape[1] // 2, 2, *field.shape[2:])
    field, target = field.view(corners), target.view(corners)
    inside = (target != 0).any(dim=2, keepdim=True)
    error = functional.smooth_l1_loss(field, target, reduction="none") * inside
    return error.flatten(1).sum(dim=1) * len(field) / inside.sum().clamp(min=1)
