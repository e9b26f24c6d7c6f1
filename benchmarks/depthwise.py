"""Depthwise convolutions under bf16 autocast on the CPU: PyTorch's own beside the project's.

``python benchmarks/depthwise.py`` runs the forward and backward pass of those that
`efficientnet_lite` learns at 128×128, a batch of 32, in one process and one thread: milliseconds a
batch of ``nn.Conv2d``, of :class:`dopepp.models.efficientnet.DepthwiseConv`, and their ratio; then
the same of the whole backbone at the quickstart's width, whose other layers do not change.
"""

from __future__ import annotations

import statistics
import time

import torch
from torch import Tensor, nn

from dopepp.models.efficientnet import DepthwiseConv, EfficientNetLite

BATCH, ROUNDS = 32, 5
# Channels, kernel, stride and side of the input.
LAYERS = (
    (240, 3, 2, 16),
    (480, 3, 1, 8),
    (480, 5, 1, 8),
    (672, 5, 1, 8),
    (672, 5, 2, 8),
    (1152, 5, 1, 4),
    (1152, 3, 1, 4),
)


def seconds(layer: nn.Module, inputs: Tensor) -> float:
    """Time one forward and backward pass under bf16 autocast."""
    start = time.perf_counter()
    with torch.autocast("cpu", torch.bfloat16):
        outputs = layer(inputs)
    outputs.float().sum().backward()
    return time.perf_counter() - start


def compare(name: str, plain: nn.Module, ours: nn.Module, inputs: Tensor) -> None:
    """Print what two layers take in turn (medians), and their ratio."""
    times: dict[str, list[float]] = {"plain": [], "ours": []}
    for _ in range(ROUNDS + 1):
        times["plain"].append(seconds(plain, inputs))
        times["ours"].append(seconds(ours, inputs))
    before, after = (1e3 * statistics.median(samples[1:]) for samples in times.values())
    print(f"{name:<24}{before:>12.1f}{after:>12.1f}{before / after:>9.2f}x")


def depthwise(make: type[nn.Conv2d], channels: int, kernel: int, stride: int) -> nn.Module:
    """Return a depthwise convolution as the network lays it in memory."""
    conv = make(channels, channels, kernel, stride, kernel // 2, groups=channels, bias=False)
    return conv.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    print(f"{'ms a batch of 32':<24}{'nn.Conv2d':>12}{'ours':>12}")
    for channels, kernel, stride, side in LAYERS:
        inputs = torch.randn(BATCH, channels, side, side, requires_grad=True)
        inputs = inputs.contiguous(memory_format=torch.channels_last)
        both = (depthwise(make, channels, kernel, stride) for make in (nn.Conv2d, DepthwiseConv))
        compare(f"{channels}, {kernel}×{kernel}, stride {stride}", *both, inputs)
    plain, ours = (
        EfficientNetLite(width=0.5).train().to(memory_format=torch.channels_last) for _ in "ab"
    )
    for layer in plain.modules():
        if isinstance(layer, DepthwiseConv):
            layer.__class__ = nn.Conv2d
    images = torch.randn(BATCH, 3, 128, 128).contiguous(memory_format=torch.channels_last)
    compare("the backbone", plain, ours, images)


if __name__ == "__main__":
    main()
