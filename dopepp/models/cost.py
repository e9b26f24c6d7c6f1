"""What a network costs: parameters and multiply–accumulates, counted without running it."""

from __future__ import annotations

import torch
from torch import nn
from torch.func import functional_call
from torch.utils.flop_counter import FlopCounterMode


def network_cost(network: nn.Module, input_size: tuple[int, int]) -> tuple[int, float]:
    """Count a network's parameters and its multiply–accumulates for one image.

    The forward pass runs on the ``meta`` device, where tensors have a shape and no values, so it
    takes milliseconds and leaves the network and its batch-norm statistics alone. Convolutions and
    matrix products are counted; what is done per element (normalisation, activation) is not.

    Args:
        network: A network that takes images (1, 3, height, width).
        input_size: Image (width, height), pixels.

    Returns:
        Number of parameters, and GMACs (10⁹ multiply–accumulates, half the GFLOPs).
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
