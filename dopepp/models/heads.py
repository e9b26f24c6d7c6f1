"""Heads, which turn feature maps into belief logits and vector fields, one pair per stage.

To add a head, write a subclass of :class:`Head` in this module and a YAML file in
``conf/model/head``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
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
"""Standard deviation of the output convolutions' weights: an untrained head returns its bias with
deviations of about a tenth, and still propagates gradients."""


class Branch(nn.Module, ABC):
    """Turns feature maps into the maps of one kind: the beliefs or the field of a stage."""

    @property
    @abstractmethod
    def outputs(self) -> list[nn.Conv2d]:
        """The convolutions that produce the maps, also the auxiliary maps."""

    @abstractmethod
    def forward(self, features: Features) -> list[Features]:
        """Return the branch's maps, preceded by auxiliary maps for the loss, if any."""


class Head(nn.Module):
    """A chain of stages, each a belief branch and a field branch.

    Stage 1 reads the features. Later stages also read the field and the belief maps of the previous
    stage; belief maps are activated, so that inputs do not depend on the loss. C objects have 9·C
    belief and 16·C field channels. ``make_branch`` builds a branch from input channels, output
    channels and stage (from 0).
    """

    cell_multiple: int = 1  # the feature map's height and width are multiples of this number

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
        check("num_objects", num_objects, int, Range(1, 256))
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
        biases = (self.activate.initial_logit, 0.0)
        for branches, bias in zip((self.belief_branches, self.field_branches), biases, strict=True):
            for output in _outputs(branches):
                if not output.weight.is_meta:  # see layers.initialise
                    nn.init.normal_(output.weight, std=_OUTPUT_STD)
                nn.init.constant_(cast(Tensor, output.bias), bias)

    @property
    def outputs(self) -> list[nn.Conv2d]:
        """The convolutions that produce maps; no other layer depends on the objects."""
        return [*_outputs(self.belief_branches), *_outputs(self.field_branches)]

    def forward(self, features: Features) -> list[Stage]:
        """Return the belief logits and vector field of every stage; the last pair is the result."""
        stages: list[Stage] = []
        branches = zip(self.belief_branches, self.field_branches, strict=True)
        for belief_branch, field_branch in branches:
            inputs = features
            if stages:
                logits, field = stages[-1]
                belief = self.activate(logits).to(features.dtype)
                inputs = torch.cat([features, belief, field.to(features.dtype)], dim=1)
            stages += zip(belief_branch(inputs), field_branch(inputs), strict=True)
        return stages


def _outputs(branches: Iterable[nn.Module]) -> list[nn.Conv2d]:
    return [layer for branch in branches for layer in cast(Branch, branch).outputs]


class Cascade(Head):
    """DOPE's cascade of 1–12 stages; DOPE has six.

    Stage 1 has three 3×3 convolutions (128), a 1×1 (512) and a 1×1 to the maps; later stages have
    five 7×7 convolutions (128), a 1×1 (128) and a 1×1 to the maps. ReLU, and batch norm if
    ``batch_norm``, follow all convolutions but the last. ``width`` is a factor on the channels.
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

        def make_branch(inputs: int, outputs: int, stage: int) -> Branch:
            steps = [(7, narrow)] * 5 + [(1, narrow)] if stage else [(3, narrow)] * 3 + [(1, wide)]
            layers: list[nn.Module] = []
            for kernel_size, channels in steps:
                layers.append(conv_block(inputs, channels, kernel_size, batch_norm=batch_norm))
                inputs = channels
            return ChainBranch(*layers, nn.Conv2d(inputs, outputs, 1))

        super().__init__(in_channels, num_objects, activation, stages, make_branch)


class ChainBranch(nn.Sequential, Branch):
    """A sequence of layers, the last of which produces the maps."""

    @property
    def outputs(self) -> list[nn.Conv2d]:
        """The last layer."""
        return [cast(nn.Conv2d, self[-1])]

    def forward(self, features: Features) -> list[Features]:
        """Return the maps of the last layer, as a list with a single entry."""
        return [super().forward(features)]  # type: ignore[no-untyped-call]


class MultiScale(Head):
    """A chain of 1 to 12 MultiScaleDOPEstages of DOPE++ (§3.3).

    ``width`` is a factor on the 128 channels. If ``batch_norm``, batch norm follows every
    convolution except output convolutions. ``maps`` selects the fusion's input from each scale:
    ``plain`` for maps of 9 or 16 channels (§3.3), ``learned`` for maps with a loss of their own,
    None for features.
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
        if maps not in (None, "plain", "learned"):
            raise UserError(f"maps={maps!r}", "plain, learned or null", "set e.g. maps=learned")

        def make_branch(inputs: int, outputs: int, stage: int) -> Branch:
            return MultiScaleBranch(inputs, channels, outputs, batch_norm, maps)

        super().__init__(in_channels, num_objects, activation, stages, make_branch)


class MultiScaleBranch(Branch):
    """One branch of a MultiScaleDOPEstage: three scales down, then top-down fusion.

    Down: five 3×3 convolutions at full scale, three at half and three at quarter scale. Up, from
    quarter to half scale and from half to full scale: a convset, a 1×1 convolution, upsampling by 2
    and concatenation with the features of the larger scale. A last convset and a 1×1 convolution
    give the maps. ReLU follows every convolution except output convolutions, because a convset
    without ReLU would be a single linear map.
    """

    def __init__(
        self, in_channels: int, channels: int, out_channels: int, batch_norm: bool, maps: str | None
    ) -> None:
        super().__init__()
        self.learned = maps == "learned"
        scale_channels = out_channels if maps else channels

        def chain(inputs: int, kernel_sizes: tuple[int, ...], stride: int = 1) -> nn.Sequential:
            blocks = []
            for size in kernel_sizes:
                block = conv_block(inputs, channels, size, stride=stride, batch_norm=batch_norm)
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
        """The convolutions that produce the maps of the scales (if learned) and the fused maps."""
        scales = [self.down_quarter, self.down_half, self.down_full] if self.learned else []
        return [*(cast(nn.Conv2d, scale[-1]) for scale in scales), self.output]

    def forward(self, features: Features) -> list[Features]:
        """Return the maps of the scales (if learned) and the fused maps; sides: multiples of 4."""
        full = self.down_full(features)
        half = self.down_half(full)
        quarter = self.down_quarter(half)
        top = self.up_quarter(quarter)
        top = self.up_half(torch.cat([double(top), half], dim=1))
        top = self.up_full(torch.cat([double(top), full], dim=1))
        sides = [double(double(quarter)), double(half), full] if self.learned else []
        return [*sides, self.output(top)]


class SharedTrunk(Head):
    """One stage with a shared trunk and a short branch each for beliefs and field.

    The trunk has ``blocks`` (1–16) residual blocks; a branch has a 3×3 and a 1×1 convolution. Both
    have ``channels`` · ``width`` channels, and batch norm after every convolution except output
    convolutions.
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
