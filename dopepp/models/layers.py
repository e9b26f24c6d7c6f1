"""Convolution blocks, width factors, initialisation and belief activations of networks.

A belief activation turns belief logits into a belief map that peaks at 1. To add an activation, add
it to :data:`ACTIVATIONS` and name it in the ``activation`` of its loss.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check

Features = Float[Tensor, "batch channels height width"]

MIN_WIDTH: Final = 1 / 64
MAX_WIDTH: Final = 4.0
CHANNELS: Final = Range(8, 1024)
BLOCKS: Final = Range(1, 16)
BLOCKS_OR_NONE: Final = Range(0, 16)
"""Bounds of options, so that a hostile spec cannot request unlimited memory."""

IMAGENET_MEAN: Final = tuple(255 * value for value in (0.485, 0.456, 0.406))
IMAGENET_STD: Final = tuple(255 * value for value in (0.229, 0.224, 0.225))
"""Statistics of red, green and blue, 0–255, that torchvision's weights expect."""

_CHANNEL_STEP: Final = 8  # Channel counts are multiples of this block size of SIMD convolutions


def scaled_channels(channels: int, width: float) -> int:
    """Scale a channel count by a factor in [1/64, 4], rounded to a multiple of 8 and at least 8."""
    width = check("width", width, float, Range(MIN_WIDTH, MAX_WIDTH))
    return max(_CHANNEL_STEP, round(channels * width / _CHANNEL_STEP) * _CHANNEL_STEP)


def conv_block(
    in_channels: int,
    out_channels: int,
    kernel_size: int,
    *,
    stride: int = 1,
    groups: int = 1,
    batch_norm: bool = False,
    relu: bool = True,
) -> nn.Sequential:
    """Return a convolution with batch norm or bias, and ReLU; ``stride`` divides the size."""
    sizes = (kernel_size, stride, kernel_size // 2)
    conv = nn.Conv2d(in_channels, out_channels, *sizes, groups=groups, bias=not batch_norm)
    norm = [nn.BatchNorm2d(out_channels)] if batch_norm else []
    return nn.Sequential(conv, *norm, *([nn.ReLU(inplace=True)] if relu else []))


class ResidualBlock(nn.Module):
    """Two 3×3 convolutions with batch norm, added to their input (He et al. 2016, Fig. 2)."""

    def __init__(self, in_channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            conv_block(in_channels, out_channels, 3, stride=stride, batch_norm=True),
            conv_block(out_channels, out_channels, 3, batch_norm=True, relu=False),
        )
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or in_channels != out_channels:
            shape = (in_channels, out_channels, 1)
            self.shortcut = conv_block(*shape, stride=stride, batch_norm=True, relu=False)

    def forward(self, features: Features) -> Features:
        """Return the sum of the residual and the shortcut, after a ReLU."""
        return functional.relu(self.residual(features) + self.shortcut(features), inplace=True)


def double(maps: Features) -> Float[Tensor, "batch channels 2*height 2*width"]:
    """Return maps of twice the height and width by nearest-neighbour upsampling."""
    return functional.interpolate(maps, scale_factor=2.0, mode="nearest")


def initialise(module: nn.Module) -> None:
    """Sample convolution and linear weights from He's normal distribution; set biases to 0.

    The variance 2 / fan_in (He et al. 2015, Eq. 10) preserves the scale of activations in networks
    without batch norm that are as deep as DOPE's cascade. Weights on the meta device are skipped,
    because sampling them would import PyTorch's compiler.
    """
    for layer in module.modules():
        if isinstance(layer, (nn.Conv2d, nn.Linear)) and not layer.weight.is_meta:
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


@dataclass(frozen=True)
class Activation:
    """An elementwise belief activation and the initial bias of an untrained head."""

    function: Callable[[Tensor], Tensor]
    initial_logit: float

    def __call__(self, logits: Features) -> Features:
        """Turn belief logits into belief maps."""
        return self.function(logits)


ACTIVATIONS: Final[Mapping[str, Activation]] = {
    # The output is the belief itself, as in DOPE; paired with MSE.
    "identity": Activation(lambda logits: logits, 0.0),
    # belief = exp(logit), at most 1 and in float32: the log link of `losses.SpatialCrossEntropy`.
    # An untrained map starts at 0.01 in every cell, so its sum equals one Gaussian of σ = 2 cells
    # on a 52×52 map (2π·2² / 52² = 0.0093) and the "how much" term starts near its minimum.
    "exp": Activation(lambda logits: logits.float().clamp(max=0.0).exp(), math.log(0.01)),
}


def find_activation(name: object) -> Activation:
    """Return the activation with this name in :data:`ACTIVATIONS`."""
    if not isinstance(name, str) or name not in ACTIVATIONS:
        fix = "choose a loss with one of these activations"
        raise UserError(f"activation {name!r:.100}", ", ".join(ACTIVATIONS), fix)
    return ACTIVATIONS[name]
