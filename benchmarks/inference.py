"""What a network costs in PyTorch on a CPU: as it was trained, and as the estimator runs it.

``python benchmarks/inference.py`` prints the 10th percentile of a frame's milliseconds, batch 1,
all sides in turn in one process, on one thread and on two.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from dopepp.models.network import PoseNetwork, build_network, network_cost

FRAMES = {128: 30, 416: 4}
CASES = (
    ("dopepp_fast", 128, 0.5),
    ("dopepp", 128, 0.25),
    ("dopepp_fast", 416, 1.0),
    ("dopepp", 416, 1.0),
)
"""Model, input size, pixels, and width: the quickstart's, and the full networks."""


def network(model: str, width: float) -> PoseNetwork:
    """Return an untrained network."""
    fast = model == "dopepp_fast"
    module = "dopepp.models"
    head = "SharedTrunk" if fast else "MultiScale"
    options = {} if fast else {"batch_norm": True, "maps": "learned"}
    backbone, attention = ("Pyramid", "Identity") if fast else ("DSC", "CBAM")
    return build_network(
        {
            "backbone": {"_target_": f"{module}.backbones.{backbone}", "width": width},
            "attention": {"_target_": f"{module}.attention.{attention}"},
            "head": {"_target_": f"{module}.heads.{head}", "width": width, **options},
            "activation": "exp",
            "num_objects": 1,
        }
    ).eval()


def milliseconds(sides: list[Callable[[], object]], frames: int) -> list[float]:
    """Time the sides in turn."""
    rows = []
    for _ in range(frames + 2):
        row = []
        for side in sides:
            start = time.perf_counter_ns()
            side()
            row.append((time.perf_counter_ns() - start) / 1e6)
        rows.append(row)
    return list(np.quantile(rows[2:], 0.1, axis=0))


@torch.inference_mode()
def main() -> None:
    """Print the table."""
    words = ("model", "size", "GMACs", "threads", "trained ms", "folded ms", "ratio", "worst maps")
    print("".join(f"{word:>12}" for word in words))
    for model, size, width in CASES:
        trained = network(model, width).to(memory_format=torch.channels_last)
        folded = trained.for_inference()
        pixels = torch.randint(0, 256, (1, size, size, 3), dtype=torch.uint8).permute(0, 3, 1, 2)
        worst = max(
            float((output - other).abs().max())
            for output, other in zip(trained.maps(pixels), folded.maps(pixels), strict=True)
        )
        cost = network_cost(trained, (size, size))[1]
        for threads in (1, 2):
            torch.set_num_threads(threads)
            sides = [partial(side.maps, pixels) for side in (trained, folded)]
            before, after = milliseconds(sides, FRAMES[size])
            times = f"{before:.1f}", f"{after:.1f}", f"{before / after:.2f}"
            row = (model, size, f"{cost:.2f}", threads, *times, f"{worst:.1e}")
            print("".join(f"{value:>12}" for value in row), flush=True)


if __name__ == "__main__":
    main()
