"""What this machine is good at: the precision to train in, and how long a run will take."""

from __future__ import annotations

import itertools
import time
from typing import Any, Final

import torch

from dopepp.data.datamodule import PoseDataModule
from dopepp.models.network import PoseNetwork

_PROBE_CHANNELS: Final = 64
_PROBE_SIZE: Final = 64
_PROBE_REPEATS: Final = 4


def choose_precision(asked: str, accelerator: str) -> tuple[str, str]:
    """Return Lightning's precision and the reason for it.

    ``auto`` takes bf16 where it is fast: on GPUs that have it and on CPUs where a probe convolution
    runs faster in it than in float32.
    """
    if asked != "auto":
        return asked, "as asked"
    if accelerator == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
        return ("bf16-mixed", "this GPU has bf16") if fast else ("32-true", "this GPU has no bf16")
    if accelerator != "cpu":
        return "32-true", f"bf16 is not probed on {accelerator}"
    full, half = _probe(torch.float32), _probe(torch.bfloat16)
    ratio = full / half
    if ratio > 1:
        return "bf16-mixed", f"bf16 is {ratio:.1f}× as fast as float32 on this CPU"
    return "32-true", f"this CPU has no fast bf16 ({ratio:.1f}× float32): expect a longer run"


def _probe(dtype: torch.dtype) -> float:
    """Time a convolution, forward and backward; the fastest of a few, seconds."""
    conv = torch.nn.Conv2d(_PROBE_CHANNELS, _PROBE_CHANNELS, 3, padding=1)
    conv = conv.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    size = (4, _PROBE_CHANNELS, _PROBE_SIZE, _PROBE_SIZE)
    images = torch.ones(size).to(memory_format=torch.channels_last)
    fastest = float("inf")
    for _ in range(_PROBE_REPEATS):
        start = time.perf_counter()
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            conv(images).float().square().mean().backward()
        fastest = min(fastest, time.perf_counter() - start)
    return fastest


def estimate_training_s(
    network: PoseNetwork, datamodule: PoseDataModule, trainer_config: dict[str, Any], precision: str
) -> float:
    """Estimate a CPU run's duration, seconds, from two images' steps and three items' loading.

    Loading is spread over the workers but shares the cores with training, so both count.
    """
    width, height = datamodule.input_size
    images = torch.zeros(2, 3, height, width).to(memory_format=torch.channels_last)
    durations = []
    for _ in range(2):
        start = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16, enabled=precision.startswith("bf16")):
            stages = network(images)
        torch.stack(
            [tensor.float().mean() for stage in stages for tensor in stage]
        ).sum().backward()
        durations.append((time.perf_counter() - start) / len(images))
    network.zero_grad(set_to_none=True)
    start = time.perf_counter()
    items = min(3, len(datamodule.train_source))
    for index in itertools.islice(range(items), items):
        datamodule.train_item(0, index)
    loading = (time.perf_counter() - start) / items / max(1, torch.get_num_threads())
    per_epoch = len(datamodule.train_source)
    num_images = per_epoch * trainer_config["max_epochs"]
    if trainer_config["max_steps"] > 0:
        num_images = min(num_images, trainer_config["max_steps"] * datamodule.batch_size)
    return (min(durations) + loading) * num_images
