"""Training speed of DOPE++ with other heads, interleaved in one process.

``python benchmarks/heads.py`` prints images a second of a training step at the laptop's scale
(width 0.25, 128×128 pixels), one thread, and each head's ratio to the first one's.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch

from dopepp.experiment.assembly.build_system import choose_precision, keep_freed_memory
from dopepp.models.losses import SpatialCrossEntropy
from dopepp.models.network import PoseNetwork, build_network, network_cost

BATCH, SIZE, WIDTH = 32, 128, 0.25
STEPS, ROUNDS = 4, 7
HEADS: dict[str, dict[str, Any]] = {
    "features handed on, 1 stage": {"maps": None},
    "2 stages": {"maps": None, "stages": 2},
    "3 stages": {"maps": None, "stages": 3},
    "6 stages": {"maps": None, "stages": 6},
    "maps handed on": {"maps": "plain"},
    "maps handed on and learned": {"maps": "learned"},
}


def network_with(head: dict[str, Any]) -> PoseNetwork:
    """Return DOPE++ with a head."""
    name = "dopepp.models.heads.MultiScale"
    return build_network(
        {
            "backbone": {"_target_": "dopepp.models.backbones.DSC", "width": WIDTH},
            "attention": {"_target_": "dopepp.models.attention.CBAM"},
            "head": {"_target_": name, "width": WIDTH, "batch_norm": True, **head},
            "activation": "exp",
            "num_objects": 1,
        }
    ).to(memory_format=torch.channels_last)


def seconds(network: PoseNetwork) -> float:
    """Time a few training steps: forward, loss and backward."""
    loss = SpatialCrossEntropy(sigma=1.0)
    images = torch.randint(0, 256, (BATCH, 3, SIZE, SIZE), dtype=torch.uint8)
    images = images.contiguous(memory_format=torch.channels_last)
    belief = torch.rand(BATCH, 9, SIZE // 8, SIZE // 8)
    field = torch.rand(BATCH, 16, SIZE // 8, SIZE // 8)
    half = choose_precision("auto", "cpu")[0].startswith("bf16")
    start = time.perf_counter()
    for _ in range(STEPS):
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            stages = network(images)
        loss(stages, belief, field)[0].backward()
    return (time.perf_counter() - start) / STEPS


def main() -> None:
    """Print a line per head."""
    torch.set_num_threads(1)
    keep_freed_memory()
    networks = {name: network_with(head) for name, head in HEADS.items()}
    times: dict[str, list[float]] = {name: [] for name in networks}
    for network in networks.values():
        seconds(network)
    for _ in range(ROUNDS):
        for name, network in networks.items():
            times[name].append(seconds(network))
    first = next(iter(times))
    for name, network in networks.items():
        ratio = statistics.median(a / b for a, b in zip(times[first], times[name], strict=True))
        gmacs = network_cost(network, (SIZE, SIZE))[1]
        rate = BATCH / statistics.median(times[name])
        print(f"{name:30} {gmacs:.3f} GMACs {rate:7.1f} images/s, {ratio:.2f} times as fast")


if __name__ == "__main__":
    main()
