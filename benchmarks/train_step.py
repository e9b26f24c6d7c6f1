"""Speed of a training step and of one prediction, for the quickstart with each network.

``python benchmarks/train_step.py [dopepp dopepp_fast …]`` runs ``experiment=quickstart`` with the
models in turn in one process. It prints

- images per second of forward, loss and backward, in the precision that training selects on this
  machine, without and with glibc keeping freed memory;
- the same in float32 and in bf16, with freed memory kept;
- milliseconds of one image's maps in float32, with freed memory returned, as in a user's program.

Ratios are relative to the first model.
"""

from __future__ import annotations

import ctypes
import statistics
import sys
import time
from collections.abc import Callable

import torch
from runtimes import untrained

from dopepp.experiment.assembly.build_system import choose_precision, keep_freed_memory
from dopepp.models.losses import SpatialCrossEntropy
from dopepp.models.network import PoseNetwork, network_cost

MODELS = ("dopepp", "dopepp_fast")
BATCH, SIZE = 32, 128
STEPS, IMAGES, ROUNDS = 5, 10, 4


def make_step(network: PoseNetwork, half: bool) -> Callable[[], None]:
    """Return a function that runs one forward and backward pass, in bf16 or in float32."""
    loss = SpatialCrossEntropy(sigma=1.0)
    images = torch.randint(0, 256, (BATCH, 3, SIZE, SIZE), dtype=torch.uint8)
    images = images.contiguous(memory_format=torch.channels_last)
    belief = torch.rand(BATCH, 9, SIZE // 8, SIZE // 8)
    field = torch.rand(BATCH, 16, SIZE // 8, SIZE // 8)

    def step() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            stages = network.train()(images)
        loss(stages, belief, field)[0].backward()

    return step


def make_prediction(network: PoseNetwork) -> Callable[[], None]:
    """Return a function that computes one image's maps in float32."""
    image = torch.randint(0, 256, (1, 3, SIZE, SIZE), dtype=torch.uint8)

    def predict() -> None:
        with torch.inference_mode():
            network.eval().maps(image)

    return predict


def seconds(call: Callable[[], None], repeats: int) -> float:
    """Return the mean time of a call, after one call that is not timed."""
    call()
    start = time.perf_counter()
    for _ in range(repeats):
        call()
    return (time.perf_counter() - start) / repeats


def return_freed_memory() -> None:
    """Set glibc's defaults: blocks of 128 KiB and more are mapped and unmapped each time."""
    libc = ctypes.CDLL(None)
    libc.mallopt(-4, 65536)
    libc.mallopt(-1, 128 * 1024)
    libc.mallopt(-3, 128 * 1024)


def main(models: tuple[str, ...]) -> None:
    """Print a line per model: its size, and each rate with its ratio to the first model's."""
    networks = {
        model: untrained(model, "experiment=quickstart")[0].to(memory_format=torch.channels_last)
        for model in models
    }
    calls = {
        model: (
            make_step(network, half=False),
            make_step(network, half=True),
            make_prediction(network),
        )
        for model, network in networks.items()
    }
    half = choose_precision("auto", "cpu")[0].startswith("bf16")
    # Per model: a step and an image with glibc's default, then both steps with memory kept.
    times: dict[str, list[tuple[float, float, float, float]]] = {model: [] for model in models}
    for _ in range(ROUNDS):
        for model, (single_step, half_step, predict) in calls.items():
            return_freed_memory()
            default = seconds(half_step if half else single_step, STEPS)
            image = seconds(predict, IMAGES)
            keep_freed_memory()
            kept = seconds(single_step, STEPS), seconds(half_step, STEPS)
            times[model].append((default, image, *kept))
    chosen = "bf16" if half else "float32"
    print(
        f"{torch.get_num_threads()} threads, {BATCH} images of {SIZE}×{SIZE}, trained in {chosen}"
    )
    first = None
    for model, rounds in times.items():
        default, image, single_s, half_s = (
            statistics.median(samples) for samples in zip(*rounds, strict=True)
        )
        kept = half_s if half else single_s
        num_parameters, gmacs = network_cost(networks[model], (SIZE, SIZE))
        first = first or (kept, image)
        print(
            f"{model:12} {num_parameters / 1e6:.2f} M weights, {gmacs:.3f} GMACs; training: "
            f"{BATCH / default:.1f} images/s, memory kept {BATCH / kept:.1f} "
            f"({first[0] / kept:.2f}×), float32 {BATCH / single_s:.1f}, bf16 {BATCH / half_s:.1f} "
            f"({single_s / half_s:.2f}×); one image: {1000 * image:.1f} ms "
            f"({first[1] / image:.2f}×)"
        )


if __name__ == "__main__":
    main(tuple(sys.argv[1:]) or MODELS)
