"""From the config to the LightningModule and the Trainer, as this machine is best at it."""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from dopepp.core.errors import UserError
from dopepp.core.pool import cpu_fact
from dopepp.data.datamodule import PoseDataModule
from dopepp.experiment import program
from dopepp.experiment.assembly.registries import CALLBACKS, optimizer_factory, scheduler_factory
from dopepp.experiment.config.run_config import MapsConfig, RunConfig, TrainerConfig
from dopepp.maps.codec import MapGeometry
from dopepp.models.checkpoint import Checkpoint, load_network
from dopepp.models.network import LOSSES, PoseNetwork, build_network
from dopepp.parts.part import Part
from dopepp.parts.size import Seen
from dopepp.recovery.detection import RecoveryOptions
from dopepp.training.loggers import MetricsTable
from dopepp.training.optimizers import AveragedWeights
from dopepp.training.processes import WatchedDDP
from dopepp.training.run_checkpoints import AtomicCheckpointIO
from dopepp.training.system import PoseSystem
from dopepp.training.throughput import RunProgress, make_profiler

# From glibc's malloc.h.
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_MAX: Final = -4

_PROBE_ITEMS: Final = 3
_PROBE_S: Final = 2.0
"""What the duration's estimate may cost: a few items and a few seconds of steps."""

_BF16_FLAGS: Final = frozenset({"amx_bf16", "bf16"})
"""x86's and Arm's names of the instruction sets."""

_AMD_BF16_FLAG: Final = "avx512_bf16"
"""Intel's multiply no faster with it than in float32, and convert besides: 0.7 times the images a
second (``benchmarks/train_step.py``). There AMX is what makes bf16 fast."""


def build_system(
    config: RunConfig,
    parts: list[Part],
    fingerprint: str,
    images: Mapping[str, Any] | None = None,
    seen: Mapping[str, Seen] | None = None,
) -> PoseSystem:
    """Build network, loss and optimiser; the checkpoint keeps what the data's images are."""
    network, description = build_untrained(config, parts)
    description = replace(
        description,
        data={
            "name": config.model.name,
            "seed": config.seed,
            "config": config.stored_data(),
            **({} if images is None else {"images": images}),
        },
        data_fingerprint=fingerprint,
        seen=dict(seen or {}),
    )
    if config.init_from is not None:
        _start_from(network, Path(config.init_from))
    return PoseSystem(
        network,
        LOSSES.build(config.model.loss),
        parts,
        map_geometry(config.maps, network.stride),
        RecoveryOptions.of(description.recovery),
        optimizer_factory(config.optimizer),
        scheduler_factory(config.scheduler),
        description.to_payload(),
        compile_network=config.compile,
        symmetry=config.symmetry,
    )


def build_untrained(config: RunConfig, parts: list[Part]) -> tuple[PoseNetwork, Checkpoint]:
    """Build the chosen network and what it is to be trained for, its data left out."""
    spec = {
        "backbone": config.model.backbone,
        "attention": config.model.attention,
        "head": config.model.head,
        "activation": LOSSES.build(config.model.loss).activation,
        "num_objects": len(parts),
    }
    network = build_network(spec)
    sigma = config.maps.sigma
    recovery = vars(RecoveryOptions.of({"sigma": sigma, **config.recovery}))
    size = config.data.network_input
    return network, Checkpoint(spec, {}, parts, size, network.stride, sigma, recovery)


def map_geometry(maps: MapsConfig, stride: int) -> MapGeometry:
    """Return how target maps are drawn, from the config's ``maps``."""
    return MapGeometry(stride, maps.sigma, maps.field_radius)


def _start_from(network: torch.nn.Module, path: Path) -> None:
    """Copy a checkpoint's weights into a network of the same shape."""
    trained, _ = load_network(path)
    try:
        network.load_state_dict(trained.state_dict())
    except RuntimeError as error:
        raise UserError(
            f"init_from={path}, whose network differs from the chosen one",
            "a checkpoint of the same backbone, attention, head, width and number of objects",
            "choose the model it was trained with",
        ) from error


def build_trainer(config: RunConfig, run_dir: Path, trackers: Sequence[Logger] = ()) -> Trainer:
    """Build Lightning's trainer with the config's callbacks, and trackers beside the CSV table."""
    options, accelerator = config.trainer, config.trainer.accelerator
    if accelerator in ("auto", "gpu") and torch.cuda.is_available():
        accelerator = "cuda"
    elif accelerator == "auto":
        accelerator = "cpu"
    precision, reason = choose_precision(options.precision, accelerator)
    if not getattr(rank_zero_only, "rank", 0):
        program.say(f"precision {precision}: {reason}")
    callbacks = [CALLBACKS.build(node) for node in config.callbacks.values()]
    if config.ema is not None:
        callbacks.append(AveragedWeights(config.ema))
    table = MetricsTable(run_dir / "metrics.csv")
    try:
        return Trainer(
            **options.lightning,
            accelerator=accelerator,
            devices=options.devices,
            num_nodes=options.num_nodes,
            strategy=_strategy(options),
            precision=precision,  # type: ignore[arg-type]
            max_epochs=options.max_epochs,
            max_steps=options.max_steps,
            profiler=make_profiler(options.profiler, run_dir),
            default_root_dir=run_dir,
            logger=[table, *trackers],
            callbacks=[*callbacks, RunProgress()],
            # A checkpoint is never newer than the table.
            plugins=[AtomicCheckpointIO(prepare=table.write, folder=run_dir)],
            enable_model_summary=False,
            num_sanity_val_steps=0,
            # The DataModule's own sampler knows rank and epoch.
            use_distributed_sampler=False,
        )
    except (MisconfigurationException, TypeError, ValueError) as error:
        raise UserError(
            f"trainer {config.plain['trainer']}, which Lightning refuses: {error}",
            "values of Lightning's Trainer that this machine can run",
            "correct the trainer's options",
        ) from error


def _strategy(options: TrainerConfig) -> str | WatchedDDP:
    """Return several processes' strategy, which notices when one of them dies."""
    chosen = options.strategy
    if chosen == "ddp" or (chosen == "auto" and options.num_processes > 1):
        return WatchedDDP(options.ddp_timeout_s)
    return chosen


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
    useful = _BF16_FLAGS | ({_AMD_BF16_FLAG} if cpu_fact("vendor_id") == "AuthenticAMD" else set())
    fast = useful & set(cpu_fact("flags", "Features").split())
    if fast:
        return "bf16-mixed", f"this CPU is fast in bf16 ({', '.join(sorted(fast))})"
    return "32-true", "no fast bf16 arithmetic in this CPU: training takes up to four times as long"


def keep_freed_memory() -> None:
    """Let glibc reuse large blocks instead of returning them to the system after each operation.

    By default every large tensor is mapped afresh, and on a CPU the page faults take up to half of
    a training step (see ``benchmarks/train_step.py``).
    """
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_MAX, 0)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


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
