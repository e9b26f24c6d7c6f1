"""Training speed of DOPE++ with different heads, in turn in one process.

``python benchmarks/heads.py`` prints images per second of a training step at ``scale=laptop``
(width 0.25, 128×128 pixels) on one thread, and each head's speed relative to the first head.
"""

from __future__ import annotations

import statistics

import torch
from runtimes import untrained
from train_step import BATCH, SIZE, make_step, seconds

from dopepp.experiment.assembly.build_system import choose_precision, keep_freed_memory
from dopepp.models.network import network_cost

STEPS, ROUNDS = 4, 7
FEATURES = "model.head.maps=null"
HEADS = {
    "features, 1 stage": [FEATURES],
    "features, 2 stages": [FEATURES, "model.head.stages=2"],
    "features, 3 stages": [FEATURES, "model.head.stages=3"],
    "features, 6 stages": [FEATURES, "model.head.stages=6"],
    "maps, plain": ["model.head.maps=plain"],
    "maps, learned": ["model.head.maps=learned"],
}
"""Options of each head: what the scales pass to the fusion, and the number of stages."""


def main() -> None:
    """Print a line per head."""
    torch.set_num_threads(1)
    keep_freed_memory()
    half = choose_precision("auto", "cpu")[0].startswith("bf16")
    networks = {
        name: untrained("dopepp", "model.width=0.25", *head)[0].to(
            memory_format=torch.channels_last
        )
        for name, head in HEADS.items()
    }
    steps = {name: make_step(network, half) for name, network in networks.items()}
    times: dict[str, list[float]] = {name: [] for name in networks}
    for _ in range(ROUNDS):
        for name, step in steps.items():
            times[name].append(seconds(step, STEPS))
    first = next(iter(times))
    for name, network in networks.items():
        ratio = statistics.median(a / b for a, b in zip(times[first], times[name], strict=True))
        gmacs = network_cost(network, (SIZE, SIZE))[1]
        rate = BATCH / statistics.median(times[name])
        print(f"{name:30} {gmacs:.3f} GMACs {rate:7.1f} images/s, {ratio:.2f} times as fast")


if __name__ == "__main__":
    main()
