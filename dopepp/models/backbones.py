"""Backbones: an RGB image to feature maps at stride 8.

To add one: a subclass of :class:`Backbone` in this module and one YAML file in
``conf/model/backbone`` (``docs/how-to/adding-a-backbone.md``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
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

POOL: Final = "pool"
Plan = tuple[int | str, ...]


class Backbone(nn.Module, ABC):
    """What a head builds upon.

    Attributes:
        out_channels: Channels of the feature maps.
        stride: Input pixels per feature cell, along each axis.
        cell_multiple: The feature map's height and width are multiples of this.
    """

    out_channels: int
    stride: int = 8
    cell_multiple: int = 1

    @abstractmethod
    def forward(self, images: Images) -> Float[Tensor, "batch channels height/8 width/8"]:
        """Return the feature maps of normalised images."""


class _Chain(Backbone):
    """Convolutions and poolings in a row."""

    layers: nn.Sequential

    def forward(self, images: Images) -> Float[Tensor, "batch channels height/8 width/8"]:
        """Return the feature maps of normalised images."""
        return self.layers(images)  # type: ignore[no-any-return]


class VGG19(_Chain):
    """DOPE's backbone: VGG19's layers 0–22, then 3×3 convolutions 512→256 and 256→128.

    Args:
        width: Factor on every channel count; 1 is the paper's.
        batch_norm: Put batch norm behind every convolution, in place of its bias.
        weights_path: A ``state_dict`` of torchvision's ``vgg19`` to start the VGG layers from. It
            is where training starts, not part of the architecture: checkpoints do not repeat it.

    Raises:
        UserError: An argument is out of range, or the file does not fit.
    """

    plan: ClassVar[Plan] = (64, 64, POOL, 128, 128, POOL, 256, 256, 256, 256, POOL, 512, 512)
    reduction: ClassVar[tuple[int, ...]] = (256, 128)

    def __init__(
        self, width: float = 1.0, batch_norm: bool = False, weights_path: str | None = None
    ) -> None:
        super().__init__()
        check("batch_norm", batch_norm, bool)
        layers: list[nn.Module] = []
        channels = 3
        for step in (*self.plan, *self.reduction):
            if isinstance(step, str):
                layers.append(nn.MaxPool2d(2))
                continue
            wider = scaled_channels(step, width)
            layers.append(conv_block(channels, wider, 3, batch_norm=batch_norm))
            channels = wider
        self.layers = nn.Sequential(*layers)
        self.out_channels = channels
        initialise(self)
        if weights_path is not None:
            if width != 1 or batch_norm or not isinstance(weights_path, str):
                got = (
                    f"weights_path={weights_path!r:.200}, width={width:g}, batch_norm={batch_norm}"
                )
                allowed = "a file's path, and only with width=1 and batch_norm=false"
                raise UserError(got, allowed, "drop weights_path, or set the other two so")
            self._load_pretrained(weights_path)

    def _load_pretrained(self, path: str) -> None:
        weights = read_mapping(Path(path), "a torchvision-format state_dict of vgg19 (.pth)")
        convolutions = [layer for layer in self.modules() if isinstance(layer, nn.Conv2d)]
        # torchvision numbers every layer: a convolution and its ReLU count two, a pooling one.
        position, number = 0, 0
        for step in self.plan:
            if step == POOL:
                position += 1
                continue
            name = f"features.{position}"
            copy_layer(weights, name, convolutions[number], path, "torchvision.models.vgg19")
            position, number = position + 2, number + 1


class VGG19Original(VGG19):
    """Table 4's "original": VGG19's first 24 layers (one convolution more), then the same two."""

    plan: ClassVar[Plan] = (*VGG19.plan, 512)


class DSC(_Chain):
    """The paper's light backbone of depthwise separable convolutions (Fig. 7).

    A 3×3 convolution, then pairs of a depthwise 3×3 and a pointwise 1×1 convolution with ReLU after
    each; three poolings bring 416×416 pixels to 52×52 cells of 128 channels. ``width`` and
    ``batch_norm`` are those of :class:`VGG19`.
    """

    plan: ClassVar[Plan] = (
        *(64, POOL, 128, 128, POOL, 256, 256, 256, 256, POOL, 512, 512, 512, 256, 128),
    )

    def __init__(self, width: float = 1.0, batch_norm: bool = False) -> None:
        super().__init__()
        check("batch_norm", batch_norm, bool)
        channels = scaled_channels(64, width)
        layers: list[nn.Module] = [conv_block(3, channels, 3, batch_norm=batch_norm)]
        for step in self.plan:
            if isinstance(step, str):
                layers.append(nn.MaxPool2d(2))
                continue
            wider = scaled_channels(step, width)
            depthwise = conv_block(channels, channels, 3, groups=channels, batch_norm=batch_norm)
            layers += [depthwise, conv_block(channels, wider, 1, batch_norm=batch_norm)]
            channels = wider
        self.layers = nn.Sequential(*layers)
        self.out_channels = channels
        initialise(self)


class Pyramid(Backbone):
    """Residual blocks at strides 4, 8, 16 and 32, summed top-down into stride 8.

    Made for time, on CPUs too: nothing is computed at the image's own resolution, where half of
    :class:`DSC`'s time goes, and every 3×3 convolution is a full one. 4×4 pixels become 48 channels
    (Shi et al. 2016), then a 3×3 convolution and the residual blocks (He et al. 2016) of each
    stride. From the coarsest back to stride 8: a 1×1 convolution, doubling, a sum with the finer
    stride's features (Lin et al. 2017), then residual blocks again. Batch norm behind every
    convolution.

    Args:
        channels: Channels at strides 4, 8, 16 and 32, each 8–1024.
        blocks: Number of residual blocks there on the way down, each 1–16.
        top_down: Number of residual blocks at strides 16 and 8 on the way back, each 0–16.
        width: Factor on every channel count.
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
    """Copy a file's tensors of a layer; a :class:`UserError` where they do not fit."""
    for key, parameter in layer.state_dict().items():
        value = weights.get(f"{name}.{key}")
        if not isinstance(value, Tensor) or value.shape != parameter.shape:
            shape = tuple(value.shape) if isinstance(value, Tensor) else "nothing"
            got, allowed = f"{shape} under {name}.{key} in {path}", tuple(parameter.shape)
            fix = f"pass a state_dict of {network}"
            raise UserError(got, f"a tensor of shape {allowed}", fix)
        parameter.copy_(value)
