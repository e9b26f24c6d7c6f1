"""CPU time of networks in PyTorch: as trained, and with batch norm folded into the convolutions.

``python benchmarks/inference.py`` prints the 10th percentile of the milliseconds per frame (batch
1) on one thread and on two. Both variants run in turn in one process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from runtimes import untrained

from dopepp.models.network import network_cost

FRAMES = {128: 30, 416: 4}
CASES = (
    ("dopepp_fast", 128, 0.5),
    ("dopepp", 128, 0.25),
    ("dopepp_fast", 416, 1.0),
    ("dopepp", 416, 1.0),
)
"""Model, input size in pixels, and width: the quickstart's network, and the full networks."""


def milliseconds(calls: list[Callable[[], object]], frames: int) -> list[float]:
    """Return the 10th percentile of each call's time; the calls run in turn."""
    rows = []
    for _ in range(frames + 2):
        row = []
        for call in calls:
            start = time.perf_counter_ns()
            call()
            row.append((time.perf_counter_ns() - start) / 1e6)
        rows.append(row)
    return list(np.quantile(rows[2:], 0.1, axis=0))


@torch.inference_mode()
def main() -> None:
    """Print the table."""
    words = ("model", "size", "GMACs", "threads", "trained ms", "folded ms", "ratio", "worst maps")
    print("".join(f"{word:>12}" for word in words))
    for model, size, width in CASES:
        trained = untrained(model, f"model.width={width}")[0].eval()
        trained = trained.to(memory_format=torch.channels_last)
        folded = trained.for_inference()
        pixels = torch.randint(0, 256, (1, size, size, 3), dtype=torch.uint8).permute(0, 3, 1, 2)
        worst = max(
            float((output - other).abs().max())
            for output, other in zip(trained.maps(pixels), folded.maps(pixels), strict=True)
        )
        cost = network_cost(trained, (size, size))[1]
        for threads in (1, 2):
            torch.set_num_threads(threads)
            calls = [partial(network.maps, pixels) for network in (trained, folded)]
            before, after = milliseconds(calls, FRAMES[size])
            times = f"{before:.1f}", f"{after:.1f}", f"{before / after:.2f}"
            row = (model, size, f"{cost:.2f}", threads, *times, f"{worst:.1e}")
            print("".join(f"{value:>12}" for value in row), flush=True)


if __name__ == "__main__":
    main()
