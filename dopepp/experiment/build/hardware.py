"""What this machine is good at: the precision to train in, and how long a run will take."""

from __future__ import annotations

import ctypes
import sys
import time
from pathlib import Path
from typing import Final

import torch

from dopepp.data.datamodule import PoseDataModule
from dopepp.experiment.config.run import TrainerConfig
from dopepp.models.network import PoseNetwork

# From glibc's malloc.h.
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_MAX: Final = -4

_PROBE_ITEMS: Final = 3
_PROBE_S: Final = 2.0
"""What the duration's estimate may cost: a few items and a few seconds of steps."""

_BF16_FLAGS: Final = frozenset({"amx_bf16", "avx512_bf16", "bf16"})
"""x86's and Arm's names of the instruction sets."""


def choose_precision(asked: str, accelerator: str) -> tuple[str, str]:
    """Return Lightning's precision and the reason for it.

    ``auto`` takes bf16 where the hardware computes in it: elsewhere it is emulated and slower. The
    choice depends on the hardware alone, not on a timing, so that a run can be repeated.
    """
    if asked != "auto":
        return asked, "as asked"
    if accelerator == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
        return ("bf16-mixed", "this GPU has bf16") if fast else ("32-true", "this GPU has no bf16")
    if accelerator != "cpu":
        return "32-true", f"bf16 is not probed on {accelerator}"
    fast = _BF16_FLAGS & _cpu_flags()
    if fast:
        return "bf16-mixed", f"this CPU has bf16 arithmetic ({', '.join(sorted(fast))})"
    return "32-true", "this CPU has no bf16 arithmetic: training takes about twice as long"


def keep_freed_memory() -> None:
    """Let glibc reuse large blocks instead of returning them to the system after each operation.

    By default every large tensor is mapped afresh, and on a CPU the page faults take up to half of
    a training step (see ``benchmarks/train_step.py``).
    """
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_MAX, 0)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def _cpu_flags() -> set[str]:
    """Return the instruction sets that Linux reports; nothing elsewhere."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    flags = [line.partition(":")[2] for line in lines if line.startswith(("flags", "Features"))]
    return set(flags[0].split()) if flags else set()


def estimate_training_s(
    network: PoseNetwork, datamodule: PoseDataModule, trainer: TrainerConfig, precision: str
) -> float:
    """Estimate a CPU run's duration, seconds, from a few steps and a few items.

    Loading is spread over the workers but shares the cores with training, so both count. An item
    is loaded twice: a cache makes the second time, and so all later epochs, cheaper.
    """
    per_epoch = len(datamodule.train_source)
    num_images = per_epoch * trainer.max_epochs
    if trainer.max_steps > 0:
        num_images = min(num_images, trainer.max_steps * datamodule.batch_size)
    threads = max(1, torch.get_num_threads())
    first, again = (_loading_s(datamodule) / threads for _ in range(2))
    num_first = min(num_images, per_epoch)
    loading = first * num_first + again * (num_images - num_first)
    return _step_s_per_image(network, datamodule, precision) * num_images + loading


def _loading_s(datamodule: PoseDataModule) -> float:
    items = min(_PROBE_ITEMS, len(datamodule.train_source))
    start = time.perf_counter()
    for index in range(items):
        datamodule.train_item(0, index)
    return (time.perf_counter() - start) / items


def _step_s_per_image(network: PoseNetwork, datamodule: PoseDataModule, precision: str) -> float:
    """Time forward and backward: one image first, then as large a batch as a few seconds allow."""
    width, height = datamodule.input_size

    def step_s(count: int) -> float:
        images = torch.zeros(count, 3, height, width).to(memory_format=torch.channels_last)
        start = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16, enabled=precision.startswith("bf16")):
            stages = network(images)
        means = [tensor.float().mean() for stage in stages for tensor in stage]
        torch.autograd.backward(torch.stack(means).sum())
        return time.perf_counter() - start

    network.eval()  # batch norm must not learn from these empty images
    step_s(1)  # the first step chooses kernels and allocates memory
    single = step_s(1)
    count = max(1, min(datamodule.batch_size, int(_PROBE_S / single)))
    step_s(count)
    duration = step_s(count) / count
    network.zero_grad(set_to_none=True)
    network.train()
    return duration
