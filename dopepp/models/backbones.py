"""Backbones, which turn an RGB image into feature maps at stride 8.

To add a backbone, write a subclass of :class:`Backbone` in this module and a YAML file in
``conf/model/backbone`` (``docs/how-to/adding-a-backbone.md``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import ClassVar, Final

from jaxtyping import Float
from torch import Tensor, nn

from dopepp.core.errors import UserError
from dopepp.core.validation import check
from dopepp.models.layers import (
    BLOCKS,
    BLOCKS_OR_NONE,
    CHANNELS,
    ResidualBlock,
    conv_block,
    double,
    initialise,
    scaled_channels,
)
from dopepp.models.storage import read_mapping

Images = Float[Tensor, "batch 3 height width"]

POOL: Final = 0
Plan = tuple[int, ...]  # Channels of convolutions, POOL for poolings


class Backbone(nn.Module, ABC):
    """Base class of backbones."""

    out_channels: int
    stride: int = 8  # input pixels per feature cell, along each axis
    cell_multiple: int = 1  # the feature map's height and width are multiples of this number

    @abstractmethod
    def forward(self, images: Images) -> Float[Tensor, "batch channels height/8 width/8"]:
        """Return the feature maps of normalised images."""


class _Chain(Backbone):
    """Convolution blocks and 2×2 max poolings in the order of a plan."""

    def __init__(
        self, plan: Plan, width: float, make_block: Callable[[int, int], list[nn.Module]]
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for step in plan:
            if step == POOL:
                layers.append(nn.MaxPool2d(2))
                continue
            wider = scaled_channels(step, width)
            layers += make_block(channels, wider)
            channels = wider
        self.layers = nn.Sequential(*layers)
        self.out_channels = channels
        initialise(self)

    def forward(self, images: Images) -> Float[Tensor, "batch channels height/8 width/8"]:
        """Return the feature maps of normalised images."""
        return self.layers(images)  # type: ignore[no-any-return]


class VGG19(_Chain):
    """DOPE's backbone: VGG19's layers 0–22, then 3×3 convolutions 512→256 and 256→128.

    Args:
        width: Multiplier of every channel count (DOPE: 1).
        batch_norm: Whether batch norm replaces the bias of every convolution.
        weights_path: File with a ``state_dict`` of torchvision's ``vgg19`` that initialises the VGG
            layers. Checkpoints do not store this path.
    """

    plan: ClassVar[Plan] = (64, 64, POOL, 128, 128, POOL, 256, 256, 256, 256, POOL, 512, 512)
    reduction: ClassVar[tuple[int, ...]] = (256, 128)

    def __init__(
        self, width: float = 1.0, batch_norm: bool = False, weights_path: str | None = None
    ) -> None:
        super().__init__(
            (*self.plan, *self.reduction),
            width,
            lambda inputs, outputs: [conv_block(inputs, outputs, 3, batch_norm=batch_norm)],
        )
        if weights_path is None:
            return
        if width != 1 or batch_norm:
            values = f"weights_path={weights_path:.200}, width={width:g}, batch_norm={batch_norm}"
            allowed = "the path of a file, with width=1 and batch_norm=false"
            fix = "leave out weights_path, or set width=1 and batch_norm=false"
            raise UserError(values, allowed, fix)
        weights = read_mapping(Path(weights_path), "a torchvision state_dict of vgg19 (.pth)")
        convolutions = (layer for layer in self.modules() if isinstance(layer, nn.Conv2d))
        # torchvision numbers all layers: a convolution has a ReLU after it, a pooling has none.
        positions = accumulate((1 if step == POOL else 2 for step in self.plan), initial=0)
        for step, position in zip(self.plan, positions, strict=False):
            if step != POOL:
                name = f"features.{position}"
                copy_layer(weights, name, next(convolutions), weights_path, "torchvision's vgg19")


class VGG19Original(VGG19):
    """Backbone "original" of DOPE++'s Table 4: :class:`VGG19` with one more VGG convolution."""

    plan: ClassVar[Plan] = (*VGG19.plan, 512)


class DSC(_Chain):
    """DOPE++'s light backbone of depthwise separable convolutions (Fig. 7).

    A 3×3 convolution, then pairs of a depthwise 3×3 and a pointwise 1×1 convolution with ReLU after
    each. Three poolings reduce 416×416 pixels to 52×52 cells of 128 channels.
    """

    plan: ClassVar[Plan] = (
        *(64, 64, POOL, 128, 128, POOL, 256, 256, 256, 256, POOL, 512, 512, 512, 256, 128),
    )

    def __init__(self, width: float = 1.0, batch_norm: bool = False) -> None:

        def make_block(inputs: int, outputs: int) -> list[nn.Module]:
            if inputs == 3:
                return [conv_block(3, outputs, 3, batch_norm=batch_norm)]
            depthwise = conv_block(inputs, inputs, 3, groups=inputs, batch_norm=batch_norm)
            return [depthwise, conv_block(inputs, outputs, 1, batch_norm=batch_norm)]

        super().__init__(self.plan, width, make_block)


class Pyramid(Backbone):
    """Residual blocks at strides 4, 8, 16 and 32, summed top-down into stride 8.

    The backbone is fast on CPUs: no layer works at full resolution, and no 3×3 convolution is
    depthwise. 4×4 pixels become 48 channels (Shi et al. 2016), followed by a 3×3 convolution and
    the residual blocks (He et al. 2016) of each stride. A 1×1 convolution and upsampling by 2
    precede each sum with finer features (Lin et al. 2017). Every convolution has batch norm.

    Args:
        channels: Channels at strides 4, 8, 16 and 32, each 8–1024.
        blocks: Number of residual blocks at these strides, each 1–16.
        top_down: Number of residual blocks after the sums at strides 16 and 8, each 0–16.
        width: Multiplier of every channel count.
    """

    cell_multiple = 4

    def __init__(
        self,
        channels: Sequence[int] = (64, 192, 256, 256),
        blocks: Sequence[int] = (1, 3, 2, 2),
        top_down: Sequence[int] = (1, 2),
        width: float = 1.0,
    ) -> None:
        super().__init__()
        counts = check("channels", channels, tuple[int, int, int, int], CHANNELS)
        blocks = check("blocks", blocks, tuple[int, int, int, int], BLOCKS)
        top_down = check("top_down", top_down, tuple[int, int], BLOCKS_OR_NONE)
        scaled = [scaled_channels(count, width) for count in counts]
        self.stem = nn.Sequential(
            nn.PixelUnshuffle(4), conv_block(3 * 4**2, scaled[0], 3, batch_norm=True)
        )
        self.down = nn.ModuleList(
            nn.Sequential(
                ResidualBlock(before, after, stride),
                *(ResidualBlock(after, after) for _ in range(count - 1)),
            )
            for before, after, stride, count in zip(
                (scaled[0], *scaled[:-1]), scaled, (1, 2, 2, 2), blocks, strict=True
            )
        )
        coarse_to_fine = list(zip(scaled[:1:-1], scaled[2:0:-1], top_down, strict=True))
        self.laterals = nn.ModuleList(
            conv_block(coarse, fine, 1, batch_norm=True, relu=False)
            for coarse, fine, _ in coarse_to_fine
        )
        self.up = nn.ModuleList(
            nn.Sequential(*(ResidualBlock(fine, fine) for _ in range(count)))
            for _, fine, count in coarse_to_fine
        )
        self.out_channels = scaled[1]
        initialise(self)

    def forward(self, images: Images) -> Float[Tensor, "batch channels height/8 width/8"]:
        """Return the feature maps of normalised images; their sides are multiples of 32."""
        scales = [self.stem(images)]
        for blocks in self.down:
            scales.append(blocks(scales[-1]))
        features = scales.pop()
        for lateral, blocks in zip(self.laterals, self.up, strict=True):
            features = blocks(scales.pop() + double(lateral(features)))
        return features  # type: ignore[no-any-return]


def copy_layer(
    weights: Mapping[str, object], name: str, layer: nn.Module, path: str, network: str
) -> None:
    """Copy the weights called ``name`` in a file to a layer; the texts are for messages."""
    for key, parameter in layer.state_dict().items():
        value = weights.get(f"{name}.{key}")
        if not isinstance(value, Tensor) or value.shape != parameter.shape:
            shape = tuple(value.shape) if isinstance(value, Tensor) else "nothing"
            problem = f"{shape} under {name}.{key} in {path}"
            allowed = f"a tensor of shape {tuple(parameter.shape)}"
            raise UserError(problem, allowed, f"pass a state_dict of {network}")
        parameter.copy_(value)
