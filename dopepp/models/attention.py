"""Attention modules between backbone and head, which keep the shape of feature maps.

To add an attention module, write a subclass of :class:`Attention` in this module, with a parameter
``channels``, and a YAML file in ``conf/model/attention``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.models.layers import Features, initialise


class Attention(nn.Module, ABC):
    """A module that re-weights feature maps without changing their shape."""

    @abstractmethod
    def forward(self, features: Features) -> Features:
        """Return the re-weighted features."""


class Identity(Attention):
    """Returns the features unchanged."""

    def __init__(self, channels: int) -> None:
        super().__init__()

    def forward(self, features: Features) -> Features:
        """Return the features unchanged."""
        return features


class SE(Attention):
    """Squeeze-and-excitation (Hu et al. 2018): features · σ(MLP(mean over the map))."""

    def __init__(self, channels: int, reduction: int = 16) -> None:
        super().__init__()
        self.mlp = _bottleneck(channels, reduction)
        initialise(self)

    def forward(self, features: Features) -> Features:
        """Return the features weighted by channel."""
        weights: Tensor = self.mlp(features.mean(dim=(2, 3))).sigmoid()
        return features * weights[:, :, None, None]


class CBAM(Attention):
    """Attention of DOPE++ (Eq. 5, 6): channel attention, then spatial attention.

    Channel: features · σ(MLP(mean) + MLP(maximum)) over the map. Spatial: features ·
    σ(conv([mean; maximum])) over the channels. ``reduction`` divides the MLP's hidden width;
    ``kernel_size`` of the convolution is odd.
    """

    def __init__(self, channels: int, reduction: int = 16, kernel_size: int = 3) -> None:
        super().__init__()
        if check("kernel_size", kernel_size, int, Range(1, 31)) % 2 == 0:
            raise UserError(f"kernel_size={kernel_size}", "an odd number", "set kernel_size=3")
        self.mlp = _bottleneck(channels, reduction)
        self.spatial = nn.Conv2d(2, 1, kernel_size, padding=kernel_size // 2, bias=False)
        initialise(self)

    def forward(self, features: Features) -> Features:
        """Return the features weighted by channel and cell."""
        squeezed = self.mlp(features.mean(dim=(2, 3))) + self.mlp(features.amax(dim=(2, 3)))
        features = features * squeezed.sigmoid()[:, :, None, None]
        pooled = torch.cat([features.mean(1, keepdim=True), features.amax(1, keepdim=True)], dim=1)
        weights: Tensor = self.spatial(pooled).sigmoid()
        return features * weights


def _bottleneck(channels: int, reduction: int) -> nn.Sequential:
    """Return W1·ReLU(W0·x) without biases, with channels / ``reduction`` (≥ 1) hidden units."""
    hidden = max(1, channels // check("reduction", reduction, int, Range(1, 1024)))
    return nn.Sequential(
        nn.Linear(channels, hidden, bias=False),
        nn.ReLU(inplace=True),
        nn.Linear(hidden, channels, bias=False),
    )
