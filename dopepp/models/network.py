"""The network: normalisation, backbone, attention and head, built from a plain spec.

A spec, which configs and checkpoints share, holds ``backbone``, ``attention`` and ``head`` nodes
(``_target_`` and arguments), ``activation`` and ``num_objects``. Channel counts are not in it: the
builder hands on what each part publishes. To make a class of another package buildable,
``BACKBONES.register(dotted name)``.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Num
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.utils.fusion import fuse_conv_bn_eval
from torch.utils.flop_counter import FlopCounterMode

from dopepp.core.errors import UserError
from dopepp.models import attention, backbones, heads, losses
from dopepp.models.layers import IMAGENET_MEAN, IMAGENET_STD, find_activation
from dopepp.models.registry import TARGET, Registry

Images = Num[Tensor, "batch 3 height width"]

BACKBONES = Registry.of_module("backbone", backbones.Backbone, backbones)  # type: ignore[type-abstract]
BACKBONES.register("dopepp.models.efficientnet.EfficientNetLite")
ATTENTIONS = Registry.of_module("attention", attention.Attention, attention)  # type: ignore[type-abstract]
HEADS = Registry.of_module("head", heads.Head, heads)
LOSSES = Registry.of_module("loss", losses.MapLoss, losses)  # type: ignore[type-abstract]

SPEC_KEYS = ("backbone", "attention", "head", "activation", "num_objects")


class PoseNetwork(nn.Module):
    """RGB images to belief maps and vector fields: backbone, attention and head.

    The normalisation is part of the network, so training, inference and exported files cannot
    disagree about it. ``stride`` is pixels per map cell, ``size_multiple`` what image height and
    width must be multiples of.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        backbone: backbones.Backbone,
        attention: attention.Attention,
        head: heads.Head,
        activation: str,
        num_objects: int,
    ) -> None:
        super().__init__()
        self.backbone, self.attention, self.head = backbone, attention, head
        self.activation, self.num_objects = activation, num_objects
        self.activate = find_activation(activation)
        self.stride = backbone.stride
        self.size_multiple = backbone.stride * math.lcm(backbone.cell_multiple, head.cell_multiple)
        # Not persistent: they are constants of the code, and a checkpoint must not alter them.
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, images: Images) -> list[heads.Stage]:
        """Return the belief logits and vector field of every stage.

        Args:
            images: RGB, 0–255, uint8 or floating point.

        Raises:
            UserError: The shape does not fit the network.
        """
        height, width = images.shape[-2:]
        fits = images.ndim == 4 and images.shape[1] == 3
        if not fits or height % self.size_multiple or width % self.size_multiple:
            sides = f"height and width multiples of {self.size_multiple}"
            got, allowed = f"images of shape {tuple(images.shape)}", "(batch, 3, height, width)"
            fix = "pad the images on the right and at the bottom"
            raise UserError(got, f"{allowed}, {sides}", fix)
        normalised = (images.to(self.mean.dtype) - self.mean) / self.std
        return self.head(self.attention(self.backbone(normalised)))  # type: ignore[no-any-return]

    def for_inference(self) -> PoseNetwork:
        """Return a copy for evaluation, batch norm multiplied into the convolutions before it.

        Its maps are the same but for rounding; it takes fewer passes and cannot be trained.
        """
        network = copy.deepcopy(self).eval()
        for chain in [one for one in network.modules() if isinstance(one, nn.Sequential)]:
            for number in reversed(range(len(chain) - 1)):
                convolution, norm = chain[number], chain[number + 1]
                if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                    chain[number] = fuse_conv_bn_eval(convolution, norm)
                    del chain[number + 1]
        return network

    def maps(self, images: Images) -> heads.Stage:
        """Return the last stage's belief maps (after the activation) and vector field."""
        logits, field = self(images)[-1]
        return self.activate(logits), field


def network_cost(network: nn.Module, input_size: tuple[int, int]) -> tuple[int, float]:
    """Return a network's parameters and 10⁹ multiply–accumulates for one (width, height) image.

    The forward pass runs on the ``meta`` device, so it takes milliseconds and leaves the network
    and its statistics alone. Convolutions and matrix products are counted, elementwise work is not.
    """
    tensors = {**dict(network.named_parameters()), **dict(network.named_buffers())}
    shapes = {name: tensor.to("meta") for name, tensor in tensors.items()}
    width, height = input_size
    # Batch norm refuses to train on a single value, which a small input's coarsest map may have.
    training = {module: module.training for module in network.modules()}
    network.eval()
    counter = FlopCounterMode(display=False)
    try:
        with torch.no_grad(), counter:
            functional_call(network, shapes, (torch.zeros(1, 3, height, width, device="meta"),))
    finally:
        for module, mode in training.items():
            module.training = mode
    num_parameters = sum(parameter.numel() for parameter in network.parameters())
    return num_parameters, counter.get_total_flops() / 2e9


def build_network(spec: Mapping[str, Any]) -> PoseNetwork:
    """Build the network that a spec describes.

    Raises:
        UserError: A key is missing or unknown, or a target or an argument is not allowed.
    """
    _check_keys(spec)
    activation, num_objects = spec["activation"], spec["num_objects"]
    backbone = BACKBONES.build(spec["backbone"])
    channels = backbone.out_channels
    weighting = ATTENTIONS.build(spec["attention"], channels=channels)
    head_inputs = {"in_channels": channels, "num_objects": num_objects, "activation": activation}
    head = HEADS.build(spec["head"], **head_inputs)
    return PoseNetwork(backbone, weighting, head, activation, num_objects)


def check_spec(spec: Mapping[str, Any]) -> None:
    """Raise a :class:`UserError` if a spec has wrong keys or targets; build nothing."""
    _check_keys(spec)
    registries: dict[str, Registry[Any]] = {
        "backbone": BACKBONES, "attention": ATTENTIONS, "head": HEADS,
    }  # fmt: skip
    for key, registry in registries.items():
        node = spec[key]
        registry.resolve(node.get(TARGET) if isinstance(node, Mapping) else node)


def _check_keys(spec: object) -> None:
    if not isinstance(spec, Mapping) or set(spec) != set(SPEC_KEYS):
        got = sorted(map(str, spec)) if isinstance(spec, Mapping) else repr(spec)[:200]
        keys = f"exactly {', '.join(SPEC_KEYS)}"
        raise UserError(f"a model spec with {got!s:.200}", keys, "add or remove keys")


def architecture(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return a deep copy of a spec without ``weights_path``.

    A checkpoint holds trained weights; its reader must not open a file of somebody else's machine.
    """
    plain: dict[str, Any] = copy.deepcopy(dict(spec))
    if isinstance(plain.get("backbone"), dict):
        plain["backbone"].pop("weights_path", None)
    return plain
