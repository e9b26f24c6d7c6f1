"""The network: normalisation, backbone, attention and head, and what one costs.

The parts are wired from what each publishes (:mod:`dopepp.models.spec`); a cost is counted without
running the network.
"""

from __future__ import annotations

import copy
import math

import torch
from jaxtyping import Num
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.utils.fusion import fuse_conv_bn_eval
from torch.utils.flop_counter import FlopCounterMode

from dopepp.core.errors import UserError
from dopepp.models.attention import Attention
from dopepp.models.backbones import Backbone
from dopepp.models.heads import Head, Stage
from dopepp.models.layers import IMAGENET_MEAN, IMAGENET_STD, find_activation

Images = Num[Tensor, "batch 3 height width"]


class PoseNetwork(nn.Module):
    """RGB images to belief maps and vector fields: backbone, attention and head.

    The normalisation is part of the network, so training, inference and exported files cannot
    disagree about it.

    Attributes:
        stride: Pixels per map cell, along each axis.
        size_multiple: Image height and width must be multiples of this.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        backbone: Backbone,
        attention: Attention,
        head: Head,
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

    def forward(self, images: Images) -> list[Stage]:
        """Return the belief logits and vector field of every stage.

        Images are RGB, 0–255, uint8 or floating point; of a shape that does not fit the network
        they are a :class:`UserError`.
        """
        height, width = images.shape[-2:]
        fits = images.ndim == 4 and images.shape[1] == 3
        if not fits or height % self.size_multiple or width % self.size_multiple:
            raise UserError(
                f"images of shape {tuple(images.shape)}",
                f"(batch, 3, height, width), height and width multiples of {self.size_multiple}",
                "pad the images on the right and at the bottom",
            )
        normalised = (images.to(self.mean.dtype) - self.mean) / self.std
        return self.head(self.attention(self.backbone(normalised)))  # type: ignore[no-any-return]

    def for_inference(self) -> PoseNetwork:
        """Return a copy for evaluation, batch norm multiplied into the convolutions before it.

        Its maps are the same but for rounding; it takes fewer passes over the features and cannot
        be trained. The network itself stays as it is.
        """
        network = copy.deepcopy(self).eval()
        for chain in [one for one in network.modules() if isinstance(one, nn.Sequential)]:
            for number in reversed(range(len(chain) - 1)):
                convolution, norm = chain[number], chain[number + 1]
                if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                    chain[number] = fuse_conv_bn_eval(convolution, norm)
                    del chain[number + 1]
        return network

    def maps(self, images: Images) -> Stage:
        """Return the last stage's belief maps (after the activation) and vector field."""
        logits, field = self(images)[-1]
        return self.activate(logits), field


def network_cost(network: nn.Module, input_size: tuple[int, int]) -> tuple[int, float]:
    """Count a network's parameters and its multiply–accumulates for one image.

    The forward pass runs on the ``meta`` device, where tensors have a shape and no values, so it
    takes milliseconds and leaves the network and its batch-norm statistics alone. Convolutions and
    matrix products are counted; what is done per element (normalisation, activation) is not.

    Returns the number of parameters, and GMACs (10⁹ multiply–accumulates, half the GFLOPs) of an
    image of (width, height) pixels.
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
