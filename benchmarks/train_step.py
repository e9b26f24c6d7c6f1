"""Speed of the quickstart with each network: a training step, and one image's maps.

``python benchmarks/train_step.py`` runs ``experiment=quickstart`` with every model below in turn in
one process: images a second of forward, loss and backward in the precision that a training here
takes, with and without glibc keeping freed memory, with memory kept in float32 and in bf16, and
milliseconds of one image's maps in float32, memory not kept, as in a user's program.
The first model is what the others are compared with. Other models:
``python benchmarks/train_step.py dopepp dopepp_fast …``.
"""

from __future__ import annotations

import ctypes
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_system import (
    build_untrained,
    choose_precision,
    keep_freed_memory,
)
from dopepp.experiment.config.run_config import RunConfig
from dopepp.models.losses import SpatialCrossEntropy
from dopepp.models.network import PoseNetwork, network_cost

CONF = Path(__file__).parents[1] / "conf"
MODELS = ("dopepp", "dopepp_fast")
BATCH, SIZE = 32, 128
STEPS, IMAGES, ROUNDS = 5, 10, 4


def make_network(model: str) -> PoseNetwork:
    """Return the quickstart's network of a model, untrained."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        node = compose("train", ["experiment=quickstart", f"model={model}"])
    config = RunConfig.of(OmegaConf.to_container(node, resolve=True))
    network, _ = build_untrained(config, build_parts(config.data))
    return network.to(memory_format=torch.channels_last)


def make_step(network: PoseNetwork, half: bool) -> Callable[[], None]:
    """Return one forward and backward pass of a network, in bf16 or in float32."""
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
    """Return one image's way through a network, in float32."""
    image = torch.randint(0, 256, (1, 3, SIZE, SIZE), dtype=torch.uint8)

    def predict() -> None:
        with torch.inference_mode():
            network.eval().maps(image)

    return predict


def seconds(call: Callable[[], None], repeats: int) -> float:
    """Time a few calls after one that is not timed."""
    call()
    start = time.perf_counter()
    for _ in range(repeats):
        call()
    return (time.perf_counter() - start) / repeats


def return_freed_memory() -> None:
    """Set glibc's defaults: blocks from 128 KiB on are mapped and unmapped each time."""
    libc = ctypes.CDLL(None)
    libc.mallopt(-4, 65536)
    libc.mallopt(-1, 128 * 1024)
    libc.mallopt(-3, 128 * 1024)


def main(models: tuple[str, ...]) -> None:
    """Print a line per model: its size, and each rate with its ratio to the first model's."""
    networks = {model: make_network(model) for model in models}
    calls = {
        model: (
            make_step(network, half=False),
            make_step(network, half=True),
            make_prediction(network),
        )
        for model, network in networks.items()
    }
    half = choose_precision("auto", "cpu")[0].startswith("bf16")
    # Of each model: a step and an image with glibc's default, steps with memory kept.
    times: dict[str, list[tuple[float, float, float, float]]] = {model: [] for model in models}
    for _ in range(ROUNDS):
        for model, (single_step, half_step, predict) in calls.items():
            return_freed_memory()
            default = seconds(half_step if half else single_step, STEPS)
            picture = seconds(predict, IMAGES)
            keep_freed_memory()
            kept = seconds(single_step, STEPS), seconds(half_step, STEPS)
            times[model].append((default, picture, *kept))
    chosen = "bf16" if half else "float32"
    print(
        f"{torch.get_num_threads()} threads, {BATCH} images of {SIZE}×{SIZE}, trained in {chosen}"
    )
    first = None
    for model, rounds in times.items():
        default, picture, single_s, half_s = (
            statistics.median(samples) for samples in zip(*rounds, strict=True)
        )
        kept = half_s if half else single_s
        num_parameters, gmacs = network_cost(networks[model], (SIZE, SIZE))
        first = first or (kept, picture)
        print(
            f"{model:12} {num_parameters / 1e6:.2f} M weights, {gmacs:.3f} GMACs; training: "
            f"{BATCH / default:.1f} images/s, memory kept {BATCH / kept:.1f} "
            f"({first[0] / kept:.2f}×), float32 {BATCH / single_s:.1f}, bf16 {BATCH / half_s:.1f} "
            f"({single_s / half_s:.2f}×); one image: {1000 * picture:.1f} ms "
            f"({first[1] / picture:.2f}×)"
        )


if __name__ == "__main__":
    main(tuple(sys.argv[1:]) or MODELS)
