"""Training speed of the quickstart's network, with and without glibc keeping freed memory.

``python benchmarks/train_step.py`` runs both settings in turn in one process and prints the ratio.
"""

from __future__ import annotations

import ctypes
import statistics
import time
from collections.abc import Callable

import torch

from dopepp.experiment.build.system import choose_precision, keep_freed_memory
from dopepp.models.losses import SpatialCrossEntropy
from dopepp.models.spec import build_network

BATCH, SIZE, WIDTH = 32, 128, 0.5
STEPS, ROUNDS = 5, 4


def make_step() -> Callable[[], None]:
    """Return one forward and backward pass of the quickstart's network."""
    network = build_network(
        {
            "backbone": {"_target_": "dopepp.models.backbones.DSC", "width": WIDTH},
            "attention": {"_target_": "dopepp.models.attention.CBAM"},
            "head": {"_target_": "dopepp.models.heads.MultiScale", "width": WIDTH},
            "activation": "exp",
            "num_objects": 1,
        }
    ).to(memory_format=torch.channels_last)
    loss = SpatialCrossEntropy(sigma=1.0)
    images = torch.randint(0, 256, (BATCH, 3, SIZE, SIZE), dtype=torch.uint8)
    images = images.contiguous(memory_format=torch.channels_last)
    belief = torch.rand(BATCH, 9, SIZE // 8, SIZE // 8)
    field = torch.rand(BATCH, 16, SIZE // 8, SIZE // 8)
    half = choose_precision("auto", "cpu")[0].startswith("bf16")

    def step() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            stages = network(images)
        loss(stages, belief, field)[0].backward()

    return step


def seconds(step: Callable[[], None]) -> float:
    """Time a few steps."""
    start = time.perf_counter()
    for _ in range(STEPS):
        step()
    return (time.perf_counter() - start) / STEPS


def return_freed_memory() -> None:
    """Set glibc's defaults: blocks from 128 KiB on are mapped and unmapped each time."""
    libc = ctypes.CDLL(None)
    libc.mallopt(-4, 65536)
    libc.mallopt(-1, 128 * 1024)
    libc.mallopt(-3, 128 * 1024)


def main() -> None:
    """Print both rates and their ratio."""
    step = make_step()
    step()
    default, kept = [], []
    for _ in range(ROUNDS):
        return_freed_memory()
        default.append(seconds(step))
        keep_freed_memory()
        step()
        kept.append(seconds(step))
    slow, fast = statistics.median(default), statistics.median(kept)
    print(f"glibc's default: {BATCH / slow:6.1f} images/s")
    print(f"memory kept:     {BATCH / fast:6.1f} images/s, {slow / fast:.2f} times as fast")


if __name__ == "__main__":
    main()
