"""The pose network: normalisation, backbone, attention and head, built from a spec.

A spec, in configs and checkpoints, holds the nodes ``backbone``, ``attention`` and ``head``
(``_target_`` and arguments), ``activation`` and ``num_objects``. Channel counts follow from the
backbone. To allow a class of another package, call ``BACKBONES.register(dotted name)``.
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
    """Turns RGB images into belief maps and vector fields.

    The network normalises images itself, so that training, inference and exported files agree.
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
        self.stride = backbone.stride  # pixels per map cell
        # Height and width of images are multiples of this number.
        self.size_multiple = backbone.stride * math.lcm(backbone.cell_multiple, head.cell_multiple)
        # Not persistent, because a checkpoint must not alter constants of the code.
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, images: Images) -> list[heads.Stage]:
        """Return the belief logits and vector field of every stage for RGB images, 0–255."""
        height, width = images.shape[-2:]
        fits = images.ndim == 4 and images.shape[1] == 3
        if not fits or height % self.size_multiple or width % self.size_multiple:
            problem = f"images of shape {tuple(images.shape)}"
            sides = f"height and width multiples of {self.size_multiple}"
            fix = "pad the images on the right and at the bottom"
            raise UserError(problem, f"(batch, 3, height, width), {sides}", fix)
        normalised = (images.to(self.mean.dtype) - self.mean) / self.std
        return self.head(self.attention(self.backbone(normalised)))  # type: ignore[no-any-return]

    def for_inference(self) -> PoseNetwork:
        """Return a faster copy with batch norm fused into convolutions.

        The maps are equal up to rounding; the copy cannot be trained.
        """
        network = copy.deepcopy(self).eval()
        chains = [module for module in network.modules() if isinstance(module, nn.Sequential)]
        for chain in chains:
            for number in reversed(range(len(chain) - 1)):
                convolution, norm = chain[number], chain[number + 1]
                if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                    chain[number] = fuse_conv_bn_eval(convolution, norm)
                    del chain[number + 1]
        return network

    def maps(self, images: Images) -> heads.Stage:
        """Return the last stage's belief maps (after the activation) and field for RGB, 0–255."""
        logits, field = self(images)[-1]
        return self.activate(logits), field


def network_cost(network: nn.Module, input_size: tuple[int, int]) -> tuple[int, float]:
    """Return the number of parameters, and 10⁹ multiply–accumulates for an image (width, height).

    The forward pass runs on the ``meta`` device, so it takes milliseconds and leaves the batch
    norm statistics unchanged. Convolutions and matrix products are counted; elementwise operations
    are not.
    """
    tensors = {**dict(network.named_parameters()), **dict(network.named_buffers())}
    shapes = {name: tensor.to("meta") for name, tensor in tensors.items()}
    width, height = input_size
    # In training mode, batch norm rejects the 1×1 maps that small inputs produce.
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
    """Build the network that a spec describes; a wrong spec raises a UserError."""
    _check_keys(spec)
    activation, num_objects = spec["activation"], spec["num_objects"]
    backbone = BACKBONES.build(spec["backbone"])
    channels = backbone.out_channels
    weighting = ATTENTIONS.build(spec["attention"], channels=channels)
    head_inputs = {"in_channels": channels, "num_objects": num_objects, "activation": activation}
    head = HEADS.build(spec["head"], **head_inputs)
    return PoseNetwork(backbone, weighting, head, activation, num_objects)


def check_spec(spec: Mapping[str, Any]) -> None:
    """Check the keys and targets of a spec without building a network."""
    _check_keys(spec)
    registries: tuple[Registry[Any], ...] = (BACKBONES, ATTENTIONS, HEADS)
    for registry in registries:
        node = spec[registry.kind]
        registry.resolve(node.get(TARGET) if isinstance(node, Mapping) else node)


def _check_keys(spec: object) -> None:
    """Raise a ``UserError`` unless a spec has exactly the keys ``SPEC_KEYS``."""
    if not isinstance(spec, Mapping) or set(spec) != set(SPEC_KEYS):
        keys = sorted(map(str, spec)) if isinstance(spec, Mapping) else repr(spec)[:200]
        allowed = f"exactly {', '.join(SPEC_KEYS)}"
        fix = "write exactly these keys, or use a checkpoint written by train.py"
        raise UserError(f"a model spec with {keys!s:.200}", allowed, fix)


def architecture(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return a deep copy of a spec without ``weights_path``, a file of the training machine."""
    plain: dict[str, Any] = copy.deepcopy(dict(spec))
    if isinstance(plain.get("backbone"), dict):
        plain["backbone"].pop("weights_path", None)
    return plain
