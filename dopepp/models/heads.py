"""Heads: feature maps to belief logits and vector fields, one pair per stage.

To add one: a subclass of :class:`Head` in this module and one YAML file in ``conf/model/head``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dopepp.geometry.cuboid import NUM_CORNERS, NUM_KEYPOINTS
from dopepp.models.activation import find_activation
from dopepp.models.gate import check_flag, check_integer
from dopepp.models.layers import conv_block, initialise, scaled_channels

Stage: TypeAlias = tuple[
    Float[Tensor, "batch 9*objects height width"], Float[Tensor, "batch 16*objects height width"]
]
"""Belief logits and vector field of one stage."""

MAX_STAGES: Final = 12
MAX_OBJECTS: Final = 64

_OUTPUT_STD: Final = 0.01
"""Standard deviation of the output convolutions' weights: an untrained head answers its bias,
give or take a tenth, and still passes a gradient on."""


class Head(nn.Module):
    """A chain of stages, each a belief branch and a field branch.

    Stage 1 reads the features; every later one reads them together with the belief maps (after the
    activation, so that both losses feed it the same thing) and the field of the stage before.

    Args:
        in_channels: Channels of the features.
        num_objects: Number of objects C; 9·C belief and 16·C field channels.
        activation: Name of the belief activation.
        stages: Number of stages.
        make_branch: Called with input channels, output channels and the stage's number (from 0);
            returns a branch, whose last convolution is its output.

    Attributes:
        cell_multiple: The feature map's height and width must be multiples of this.

    Raises:
        UserError: An argument is out of range.
    """

    cell_multiple: int = 1

    def __init__(
        self,
        in_channels: int,
        num_objects: int,
        activation: str,
        stages: int,
        make_branch: Callable[[int, int, int], nn.Module],
    ) -> None:
        super().__init__()
        self.activate = find_activation(activation)
        check_integer("num_objects", num_objects, 1, MAX_OBJECTS)
        check_integer("stages", stages, 1, MAX_STAGES)
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
            for branch in branches:
                _start_output(branch, bias)

    def forward(self, features: Float[Tensor, "batch channels height width"]) -> list[Stage]:
        """Return every stage's belief logits and vector field."""
        stages: list[Stage] = []
        for belief_branch, field_branch in zip(
            self.belief_branches, self.field_branches, strict=True
        ):
            inputs = features
            if stages:
                logits, field = stages[-1]
                belief = self.activate(logits).to(features.dtype)
                inputs = torch.cat([features, belief, field.to(features.dtype)], dim=1)
            stages.append((belief_branch(inputs), field_branch(inputs)))
        return stages


class Cascade(Head):
    """DOPE's cascade: six stages, from the second on with 7×7 convolutions.

    Stage 1: three 3×3 convolutions (128), 1×1 to 512, 1×1 to the maps. Later stages: five 7×7
    (128), 1×1 (128), 1×1 to the maps. ReLU after all but the last.

    Args:
        in_channels: Channels of the features.
        num_objects: Number of objects.
        activation: Name of the belief activation.
        stages: Number of stages, 1–12; DOPE's are 6.
        width: Factor on the channel counts; 1 is the paper's.
        batch_norm: Put batch norm behind every convolution but the last, in place of its bias.

    Raises:
        UserError: An argument is out of range.
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
        check_flag("batch_norm", batch_norm)

        def make_branch(inputs: int, outputs: int, stage: int) -> nn.Module:
            steps = [(7, narrow)] * 5 + [(1, narrow)] if stage else [(3, narrow)] * 3 + [(1, wide)]
            layers: list[nn.Module] = []
            for kernel_size, channels in steps:
                layers.append(conv_block(inputs, channels, kernel_size, batch_norm=batch_norm))
                inputs = channels
            return nn.Sequential(*layers, nn.Conv2d(inputs, outputs, 1))

        super().__init__(in_channels, num_objects, activation, stages, make_branch)


class MultiScale(Head):
    """The paper's MultiScaleDOPEstage (§3.3), one or more of them.

    Args:
        in_channels: Channels of the features.
        num_objects: Number of objects.
        activation: Name of the belief activation.
        stages: Number of stages, 1–12.
        width: Factor on the channel counts; 1 is 128 channels.
        batch_norm: Put batch norm behind every convolution but the last, in place of its bias.

    Raises:
        UserError: An argument is out of range.
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
    ) -> None:
        channels = scaled_channels(128, width)
        check_flag("batch_norm", batch_norm)

        def make_branch(inputs: int, outputs: int, stage: int) -> nn.Module:
            return MultiScaleBranch(inputs, channels, outputs, batch_norm)

        super().__init__(in_channels, num_objects, activation, stages, make_branch)


class MultiScaleBranch(nn.Module):
    """One branch of a MultiScaleDOPEstage: three scales down, then top-down fusion.

    Down: five 3×3 convolutions at full scale, three to one half, three to one quarter (the first
    of the three with stride 2). Up: convset at a quarter, 1×1, ×2 nearest, concatenated with the
    half scale; the same again into full scale; convset; 1×1 to the maps. ReLU after every
    convolution but the last: without one between them a convset's five would be one linear map.

    Args:
        in_channels: Channels in.
        channels: Channels inside.
        out_channels: Channels of the maps.
        batch_norm: As in :class:`MultiScale`.
    """

    def __init__(
        self, in_channels: int, channels: int, out_channels: int, batch_norm: bool
    ) -> None:
        super().__init__()

        def chain(inputs: int, kernel_sizes: tuple[int, ...], stride: int = 1) -> nn.Sequential:
            return nn.Sequential(
                *(
                    conv_block(
                        channels if position else inputs,
                        channels,
                        kernel_size,
                        stride=1 if position else stride,
                        batch_norm=batch_norm,
                    )
                    for position, kernel_size in enumerate(kernel_sizes)
                )
            )

        convset = (1, 3, 1, 1, 3)
        self.down_full = chain(in_channels, (3,) * 5)
        self.down_half = chain(channels, (3,) * 3, stride=2)
        self.down_quarter = chain(channels, (3,) * 3, stride=2)
        self.up_quarter = chain(channels, (*convset, 1))
        self.up_half = chain(2 * channels, (*convset, 1))
        self.up_full = chain(2 * channels, convset)
        self.output = nn.Conv2d(channels, out_channels, 1)

    def forward(
        self, features: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch out_channels height width"]:
        """Return the maps; height and width must be multiples of 4."""
        full = self.down_full(features)
        half = self.down_half(full)
        top = self.up_quarter(self.down_quarter(half))
        top = self.up_half(torch.cat([_double(top), half], dim=1))
        top = self.up_full(torch.cat([_double(top), full], dim=1))
        return self.output(top)  # type: ignore[no-any-return]


def _double(maps: Tensor) -> Tensor:
    return functional.interpolate(maps, scale_factor=2.0, mode="nearest")


def _start_output(branch: nn.Module, bias: float) -> None:
    """Let a branch's output convolution, its last, answer little more than its bias."""
    output = [layer for layer in branch.modules() if isinstance(layer, nn.Conv2d)][-1]
    nn.init.normal_(output.weight, std=_OUTPUT_STD)
    if output.bias is not None:
        nn.init.constant_(output.bias, bias)
