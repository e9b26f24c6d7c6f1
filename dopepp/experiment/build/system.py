"""From the config to the LightningModule and the Trainer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import Trainer
from lightning.pytorch.loggers import Logger

from dopepp.core.errors import UserError
from dopepp.experiment.build.hardware import choose_precision
from dopepp.experiment.build.registries import CALLBACKS, optimizer_factory, scheduler_factory
from dopepp.experiment.config.run import MapsConfig, RunConfig, TrainerConfig
from dopepp.experiment.runs import display
from dopepp.inference.estimator import parse_recovery
from dopepp.maps.encode import MapGeometry
from dopepp.models.checkpoint.schema import Checkpoint, load_network
from dopepp.models.network import PoseNetwork
from dopepp.models.spec import LOSSES, build_network
from dopepp.parts.part import Part
from dopepp.training.callbacks.averaging import AveragedWeights
from dopepp.training.callbacks.throughput import RunProgress, make_profiler
from dopepp.training.checkpointing.files import AtomicCheckpointIO
from dopepp.training.loggers import MetricsTable
from dopepp.training.processes import WatchedDDP
from dopepp.training.system import PoseSystem


def build_system(
    config: RunConfig, parts: list[Part], fingerprint: str, images: Mapping[str, Any] | None = None
) -> PoseSystem:
    """Build the network, its loss and its optimiser as the config names them.

    Fingerprint and description of the data's images, by split, are kept in the checkpoint.
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
    )
    if config.init_from is not None:
        _start_from(network, Path(config.init_from))
    return PoseSystem(
        network,
        LOSSES.build(config.model.loss),
        parts,
        map_geometry(config.maps, network.stride),
        parse_recovery(description.recovery),
        optimizer_factory(config.optimizer),
        scheduler_factory(config.scheduler),
        description.to_payload(),
        compile_network=config.compile,
        symmetry=config.symmetry,
    )


def build_untrained(config: RunConfig, parts: list[Part]) -> tuple[PoseNetwork, Checkpoint]:
    """Build the chosen network and what it is to be trained for, its data left out.

    Its spec is the chosen components, and what the loss and the objects decide. A
    :class:`UserError` tells which choice or threshold is wrong.
    """
    spec = {
        "backbone": config.model.backbone,
        "attention": config.model.attention,
        "head": config.model.head,
        "activation": LOSSES.build(config.model.loss).activation,
        "num_objects": len(parts),
    }
    network = build_network(spec)
    sigma = config.maps.sigma
    recovery = vars(parse_recovery({"sigma": sigma, **config.recovery}))
    size = config.data.input_size
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
    """Build Lightning's trainer with the config's callbacks.

    Trackers are loggers besides the CSV table that is always on. A :class:`UserError`: a callback
    is wrong, or Lightning refuses an option.
    """
    options, accelerator = config.trainer, config.trainer.accelerator
    if accelerator in ("auto", "gpu") and torch.cuda.is_available():
        accelerator = "cuda"
    elif accelerator == "auto":
        accelerator = "cpu"
    precision, reason = choose_precision(options.precision, accelerator)
    display.console.print(f"precision {precision}: {reason}")
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
