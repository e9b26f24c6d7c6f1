"""Heads: feature maps to belief logits and vector fields, one pair per stage.

To add one: a subclass of :class:`Head` in this module and one YAML file in ``conf/model/head``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Final, TypeAlias, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.geometry.cuboid import NUM_CORNERS, NUM_KEYPOINTS
from dopepp.models.layers import (
    BLOCKS,
    CHANNELS,
    Features,
    ResidualBlock,
    conv_block,
    double,
    find_activation,
    initialise,
    scaled_channels,
)

Beliefs = Float[Tensor, "batch 9*objects height width"]
Fields = Float[Tensor, "batch 16*objects height width"]
Stage: TypeAlias = tuple[Beliefs, Fields]  # Belief logits and vector field of one stage

_OUTPUT_STD: Final = 0.01
"""Standard deviation of the output convolutions' weights: an untrained head answers its bias,
give or take a tenth, and still passes a gradient on."""


class Branch(nn.Module, ABC):
    """Feature maps to one kind of maps: a stage's beliefs or its field."""

    @property
    @abstractmethod
    def outputs(self) -> list[nn.Conv2d]:
        """The convolutions that answer maps."""

    @abstractmethod
    def forward(self, features: Features) -> list[Features]:
        """Return the branch's maps as the last; before them, what else is to be learned from."""


class Head(nn.Module):
    """A chain of stages, each a belief branch and a field branch.

    Stage 1 reads the features; every later one reads them together with the belief maps (after the
    activation, so that both losses feed it the same thing) and the field of the stage before. For C
    objects there are 9·C belief and 16·C field channels. ``make_branch`` takes input channels,
    output channels and the stage's number (from 0). ``cell_multiple`` is what the feature map's
    height and width must be multiples of.
    """

    cell_multiple: int = 1

    def __init__(
        self,
        in_channels: int,
        num_objects: int,
        activation: str,
        stages: int,
        make_branch: Callable[[int, int, int], Branch],
    ) -> None:
        super().__init__()
        self.activate = find_activation(activation)
        check("num_objects", num_objects, int, Range(1, 64))
        check("stages", stages, int, Range(1, 12))
        outputs = (NUM_KEYPOINTS * num_objects, 2 * NUM_CORNERS * num_objects)
        self.belief_branches, self.field_branches = (
            nn.ModuleList(
                make_branch(in_channels + (sum(outputs) if stage else 0), out_channels, stage)
                for stage in range(stages)
            )
            for out_channels in outputs
        )
        initialise(self)
        for branches, bias in (
            (self.belief_branches, self.activate.initial_logit),
            (self.field_branches, 0.0),
        ):
            for output in (one for branch in branches for one in cast(Branch, branch).outputs):
                if not output.weight.is_meta:  # see layers.initialise
                    nn.init.normal_(output.weight, std=_OUTPUT_STD)
                nn.init.constant_(cast(Tensor, output.bias), bias)

    def forward(self, features: Features) -> list[Stage]:
        """Return every stage's belief logits and vector field, the head's answer as the last."""
        stages: list[Stage] = []
        for belief_branch, field_branch in zip(
            self.belief_branches, self.field_branches, strict=True
        ):
            inputs = features
            if stages:
                logits, field = stages[-1]
                belief = self.activate(logits).to(features.dtype)
                inputs = torch.cat([features, belief, field.to(features.dtype)], dim=1)
            stages += zip(belief_branch(inputs), field_branch(inputs), strict=True)
        return stages


class Cascade(Head):
    """DOPE's cascade of 1–12 stages: six in DOPE, from the second on with 7×7 convolutions.

    Stage 1: three 3×3 convolutions (128), 1×1 to 512, 1×1 to the maps. Later stages: five 7×7
    (128), 1×1 (128), 1×1 to the maps. ReLU after all but the last. ``width`` is a factor on the
    channel counts; batch norm stands behind every convolution but the last, in place of its bias.
    """

    def __init__(
        self,
        in_channels: int,
        num_objects: int,
        activation: str = "identity",
        stages: int = 6,
        width: float = 1.0,
        batch_norm: bool = False,
    ) -> None:
        narrow, wide = scaled_channels(128, width), scaled_channels(512, width)
        check("batch_norm", batch_norm, bool)

        def make_branch(inputs: int, outputs: int, stage: int) -> Branch:
            steps = [(7, narrow)] * 5 + [(1, narrow)] if stage else [(3, narrow)] * 3 + [(1, wide)]
            layers: list[nn.Module] = []
            for kernel_size, channels in steps:
                layers.append(conv_block(inputs, channels, kernel_size, batch_norm=batch_norm))
                inputs = channels
            return ChainBranch(*layers, nn.Conv2d(inputs, outputs, 1))

        super().__init__(in_channels, num_objects, activation, stages, make_branch)


class ChainBranch(nn.Sequential, Branch):
    """Layers in order; the last answers the maps."""

    @property
    def outputs(self) -> list[nn.Conv2d]:
        """The last layer."""
        return [cast(nn.Conv2d, self[-1])]

    def forward(self, features: Features) -> list[Features]:
        """Return the maps."""
        return [super().forward(features)]  # type: ignore[no-untyped-call]


class MultiScale(Head):
    """The paper's MultiScaleDOPEstage (§3.3), 1 to 12 of them.

    ``width`` is a factor on the channel counts, 1 is 128 channels; batch norm stands behind every
    convolution but those of maps. ``maps`` is what the three scales hand to the fusion: ``plain``
    for maps of 9 or 16 channels each, as §3.3 has them; ``learned`` for the same, which the loss
    sees as well, before the fused ones; None for features.
    """

    cell_multiple = 4

    def __init__(
        self,
        in_channels: int,
        num_objects: int,
        activation: str = "identity",
        stages: int = 1,
        width: float = 1.0,
        batch_norm: bool = False,
        maps: str | None = None,
    ) -> None:
        channels = scaled_channels(128, width)
        check("batch_norm", batch_norm, bool)
        if maps not in (None, "plain", "learned"):
            raise UserError(f"maps={maps!r}", "plain, learned or null", "choose one of them")

        def make_branch(inputs: int, outputs: int, stage: int) -> Branch:
            return MultiScaleBranch(inputs, channels, outputs, batch_norm, maps)

        super().__init__(in_channels, num_objects, activation, stages, make_branch)


class MultiScaleBranch(Branch):
    """One branch of a MultiScaleDOPEstage: three scales down, then top-down fusion.

    Down: five 3×3 convolutions at full scale, three to one half, three to one quarter. Up: convset
    at a quarter, 1×1, ×2 nearest, concatenated with the half scale; the same again into full scale;
    convset; 1×1 to the maps. ReLU after every convolution but those of maps: without one between
    them a convset's five would be one linear map.
    """

    def __init__(
        self, in_channels: int, channels: int, out_channels: int, batch_norm: bool, maps: str | None
    ) -> None:
        super().__init__()
        self.learned = maps == "learned"
        scale_channels = out_channels if maps else channels

        def chain(inputs: int, kernel_sizes: tuple[int, ...], stride: int = 1) -> nn.Sequential:
            blocks = []
            for kernel_size in kernel_sizes:
                block = conv_block(
                    inputs, channels, kernel_size, stride=stride, batch_norm=batch_norm
                )
                blocks.append(block)
                inputs, stride = channels, 1
            return nn.Sequential(*blocks)

        def scale(inputs: int, length: int, stride: int = 1) -> nn.Sequential:
            if not maps:
                return chain(inputs, (3,) * length, stride)
            to_maps = nn.Conv2d(channels, out_channels, 3, padding=1)
            return nn.Sequential(*chain(inputs, (3,) * (length - 1), stride), to_maps)

        convset = (1, 3, 1, 1, 3)
        self.down_full = scale(in_channels, 5)
        self.down_half = scale(scale_channels, 3, stride=2)
        self.down_quarter = scale(scale_channels, 3, stride=2)
        self.up_quarter = chain(scale_channels, (*convset, 1))
        self.up_half = chain(channels + scale_channels, (*convset, 1))
        self.up_full = chain(channels + scale_channels, convset)
        self.output = nn.Conv2d(channels, out_channels, 1)

    @property
    def outputs(self) -> list[nn.Conv2d]:
        """The fused maps' convolution, and those of the scales' where they are learned."""
        scales = [self.down_quarter, self.down_half, self.down_full] if self.learned else []
        return [*(cast(nn.Conv2d, one[-1]) for one in scales), self.output]

    def forward(self, features: Features) -> list[Features]:
        """Return the maps; height and width must be multiples of 4."""
        full = self.down_full(features)
        half = self.down_half(full)
        quarter = self.down_quarter(half)
        top = self.up_quarter(quarter)
        top = self.up_half(torch.cat([double(top), half], dim=1))
        top = self.up_full(torch.cat([double(top), full], dim=1))
        sides = [double(double(quarter)), double(half), full] if self.learned else []
        return [*sides, self.output(top)]


class SharedTrunk(Head):
    """One stage whose beliefs and field come from one trunk, by a short branch each.

    Trunk: ``blocks`` residual blocks of two 3×3 convolutions, 1–16. Branch: 3×3, then 1×1 to the
    maps. Both have ``channels`` · ``width`` channels, and batch norm behind every convolution but
    those of maps.
    """

    def __init__(
        self,
        in_channels: int,
        num_objects: int,
        activation: str = "identity",
        channels: int = 192,
        blocks: int = 1,
        width: float = 1.0,
    ) -> None:
        inside = scaled_channels(check("channels", channels, int, CHANNELS), width)
        check("blocks", blocks, int, BLOCKS)

        def make_branch(inputs: int, outputs: int, stage: int) -> Branch:
            convolution = conv_block(inside, inside, 3, batch_norm=True)
            return ChainBranch(convolution, nn.Conv2d(inside, outputs, 1))

        super().__init__(in_channels, num_objects, activation, 1, make_branch)
        self.trunk = nn.Sequential(
            ResidualBlock(in_channels, inside),
            *(ResidualBlock(inside, inside) for _ in range(blocks - 1)),
        )
        initialise(self.trunk)

    def forward(self, features: Features) -> list[Stage]:
        """Return the belief logits and vector field of the only stage."""
        return super().forward(self.trunk(features))
