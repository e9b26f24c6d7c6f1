"""Build the LightningModule and the Trainer from a config, with devices and precision.

To allow an optimiser, scheduler, callback or logger of your own, register its dotted name before
the run starts (``CALLBACKS.register("my_package.my_module.MyCallback")``) or list the name here.
"""

from __future__ import annotations

import ctypes
import inspect
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import Logger
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from dopepp.core.errors import UserError
from dopepp.core.pool import cpu_fact
from dopepp.experiment import program
from dopepp.experiment.config.run_config import AUTO, RunConfig
from dopepp.maps.codec import MapGeometry
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.network import LOSSES, PoseNetwork, build_network
from dopepp.models.registry import TARGET, Registry
from dopepp.models.start import FITS, start_from_checkpoint, start_from_parts
from dopepp.parts.part import Part
from dopepp.parts.size import LearnedRange
from dopepp.recovery.detection import RecoveryOptions
from dopepp.training.loggers import MetricsTable
from dopepp.training.optimizers import AveragedWeights
from dopepp.training.processes import WatchedDDP, is_rank_zero
from dopepp.training.run_checkpoints import AtomicCheckpointIO
from dopepp.training.system import OptimizerFactory, PoseSystem, SchedulerFactory
from dopepp.training.throughput import RunProgress, make_profiler

T = TypeVar("T")


OPTIMIZERS: Registry[Optimizer] = Registry(
    "optimizer",
    Optimizer,
    (
        "dopepp.training.optimizers.Muon",
        *(f"torch.optim.{name}" for name in ("Adam", "AdamW", "RMSprop", "SGD")),
    ),
)
SCHEDULERS: Registry[LRScheduler] = Registry(
    "scheduler",
    LRScheduler,
    (f"torch.optim.lr_scheduler.{name}LR" for name in ("CosineAnnealing", "Linear", "OneCycle")),
)
CALLBACKS: Registry[Callback] = Registry(
    "callback",
    Callback,
    (
        "dopepp.training.pose_validation.AUCCurves",
        "dopepp.training.pose_validation.BeliefMaps",
        "dopepp.training.pose_validation.EarlyStop",
        "dopepp.training.guards.EmptyMaps",
        "dopepp.training.guards.FiniteSteps",
        "dopepp.training.last_checkpoint.LastCheckpoint",
        "dopepp.training.pose_validation.Overlays",
        "dopepp.training.pose_validation.PoseMetricsCallback",
        "dopepp.training.throughput.Throughput",
        "dopepp.training.pruning.TrialReport",
        "lightning.pytorch.callbacks.EarlyStopping",
        "lightning.pytorch.callbacks.LearningRateMonitor",
        "lightning.pytorch.callbacks.ModelCheckpoint",
        "lightning.pytorch.callbacks.Timer",
    ),
)
LOGGERS: Registry[Logger] = Registry(
    "logger",
    Logger,  # type: ignore[type-abstract]
    ("lightning.pytorch.loggers.TensorBoardLogger", "lightning.pytorch.loggers.WandbLogger"),
)


def build_system(
    config: RunConfig,
    parts: list[Part],
    fingerprint: str,
    images: Mapping[str, Any] | None = None,
    seen: Mapping[str, LearnedRange] | None = None,
) -> PoseSystem:
    """Build the LightningModule: initialised network, loss, optimiser and schedule.

    Checkpoints store ``fingerprint``, a hash of the data, and by split and part the descriptions of
    ``images`` and the trained sizes and distances ``seen``.
    """
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
    if config.init_from == AUTO:
        fits = start_from_parts(network)
        if config.resume is None and is_rank_zero():
            default = f"default, because the weights of random parts fit only {FITS}"
            chosen = "learned on random parts (init_from=auto)" if fits else default
            program.print_line(f"initial weights: {chosen}")
    elif config.init_from is not None:
        start_from_checkpoint(network, Path(config.init_from))
    return PoseSystem(
        network,
        LOSSES.build(config.model.loss),
        parts,
        MapGeometry(network.stride, config.maps.sigma, config.maps.field_radius),
        RecoveryOptions.of(description.recovery),
        optimizer_factory(config.optimizer),
        scheduler_factory(config.scheduler),
        description.to_payload(),
        compile_network=config.compile,
        symmetry=config.symmetry,
    )


def build_untrained(config: RunConfig, parts: list[Part]) -> tuple[PoseNetwork, Checkpoint]:
    """Build the untrained network, and a checkpoint that describes it, without weights and data."""
    spec = {
        "backbone": config.model.backbone,
        "attention": config.model.attention,
        "head": config.model.head,
        "activation": LOSSES.build(config.model.loss).activation,
        "num_objects": len(parts),
    }
    network = build_network(spec)
    sigma, maps = config.maps.sigma, vars(config.maps)
    recovery = vars(RecoveryOptions.of({**maps, **config.recovery}))
    size = config.data.network_input
    return network, Checkpoint(spec, {}, parts, size, network.stride, sigma, recovery)


def build_trainer(
    config: RunConfig,
    run_dir: Path,
    trackers: Sequence[Logger] = (),
    further: Sequence[Callback] = (),
) -> Trainer:
    """Build Lightning's trainer with the CSV table, and the callbacks of the config.

    ``trackers`` and ``further`` are additional loggers and callbacks.
    """
    options, accelerator = config.trainer, config.trainer.accelerator
    if accelerator in ("auto", "gpu") and torch.cuda.is_available():
        accelerator = "cuda"
    elif accelerator == "auto":
        accelerator = "cpu"
    precision, reason = choose_precision(options.precision, accelerator)
    if is_rank_zero():
        program.print_line(f"precision {precision}: {reason}")
    callbacks = [*(CALLBACKS.build(node) for node in config.callbacks.values()), *further]
    if config.ema is not None:
        callbacks.append(AveragedWeights(config.ema))
    strategy: str | WatchedDDP = options.strategy
    if strategy == "ddp" or (strategy == "auto" and options.num_processes > 1):
        strategy = WatchedDDP(options.ddp_timeout_s)  # detects the death of a process
    table = MetricsTable(run_dir / "metrics.csv")
    try:
        return Trainer(
            **options.lightning,
            accelerator=accelerator,
            devices=options.devices,
            num_nodes=options.num_nodes,
            strategy=strategy,
            precision=precision,  # type: ignore[arg-type]
            max_epochs=options.max_epochs,
            max_steps=options.max_steps,
            profiler=make_profiler(options.profiler, run_dir),
            default_root_dir=run_dir,
            logger=[table, *trackers],
            callbacks=[*callbacks, RunProgress()],
            # The table is written before each checkpoint, so a checkpoint is never newer.
            plugins=[AtomicCheckpointIO(prepare=table.write, folder=run_dir)],
            enable_model_summary=False,
            num_sanity_val_steps=0,
            # The sampler of the DataModule handles rank and epoch.
            use_distributed_sampler=False,
        )
    except (MisconfigurationException, TypeError, ValueError) as error:
        raise UserError(
            f"trainer {config.plain['trainer']}, which Lightning rejects: {error}",
            "values of Lightning's Trainer that this machine can run",
            "change or remove the option trainer.… that this message names",
        ) from error


def choose_precision(requested: str, accelerator: str) -> tuple[str, str]:
    """Return Lightning's name of the precision, and the reason for the choice.

    ``auto`` selects bf16 if the hardware supports it; the choice depends on no timings.
    """
    if requested != "auto":
        return requested, "as requested"
    if accelerator == "cuda":
        if torch.cuda.is_bf16_supported(including_emulation=False):
            return "bf16-mixed", "this GPU supports bf16"
        return "32-true", "this GPU has no bf16"
    if accelerator != "cpu":
        return "32-true", f"bf16 support is not checked on {accelerator}"
    useful = {"amx_bf16", "bf16"}  # on x86 and Arm
    if cpu_fact("vendor_id") == "AuthenticAMD":
        useful.add("avx512_bf16")  # on Intel slower than float32 (benchmarks/train_step.py)
    fast = useful & set(cpu_fact("flags", "Features").split())
    if fast:
        return "bf16-mixed", f"this CPU has fast bf16 instructions ({', '.join(sorted(fast))})"
    return (
        "32-true",
        "this CPU has no fast bf16 instructions: training takes up to four times as long",
    )


def keep_freed_memory() -> None:
    """Let glibc reuse large blocks, because page faults slow training on a CPU down.

    By default every large tensor is mapped again (``benchmarks/train_step.py``).
    """
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        libc = ctypes.CDLL(None)
        libc.mallopt(-4, 0)  # M_MMAP_MAX
        libc.mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD


def optimizer_factory(node: Mapping[str, Any]) -> OptimizerFactory:
    """Return a function from parameters to the optimiser of a node, which is checked at once."""

    def make(parameters: Iterable[nn.Parameter]) -> Optimizer:
        return OPTIMIZERS.build(node, params=list(parameters))

    make([nn.Parameter()])
    return make


def scheduler_factory(node: Mapping[str, Any]) -> SchedulerFactory | None:
    """Return a function from optimiser and number of steps to the scheduler; None for no target."""
    if node.get(TARGET) is None:
        return None
    parameters = inspect.signature(SCHEDULERS.resolve(node[TARGET])).parameters
    total = next(name for name in ("total_steps", "T_max", "total_iters") if name in parameters)

    def make(optimizer: Optimizer, num_steps: int) -> LRScheduler:
        try:
            return SCHEDULERS.build(node, optimizer=optimizer, **{total: max(1, num_steps)})
        except ZeroDivisionError:  # OneCycleLR with a warm-up of exactly one step
            return SCHEDULERS.build(node, optimizer=optimizer, **{total: num_steps + 1})

    return make


def build_optional(kind: str, base: type[T], node: Mapping[str, Any]) -> T | None:
    """Build an object of class ``base`` from a config node; None if the node has no target."""
    registry = Registry(kind, base, [f"{base.__module__}.{base.__qualname__}"])
    return None if node.get(TARGET) is None else registry.build(node)
