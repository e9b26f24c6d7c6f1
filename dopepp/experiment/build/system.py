"""From a plain config to the LightningModule and the Trainer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import Logger

from dopepp.core.checks import check_integer, check_number
from dopepp.core.errors import UserError
from dopepp.experiment.build.hardware import choose_precision, num_processes
from dopepp.experiment.build.registries import (
    CALLBACKS,
    optimizer_factory,
    scheduler_factory,
)
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
from dopepp.training.symmetry import SymmetryOptions
from dopepp.training.system import PoseSystem

_MAX_EPOCHS: Final = 10**9
_MAX_WAIT_S: Final = 7 * 24 * 3600
_MIN_CELLS: Final = 0.1
"""A peak or disc narrower than this, in cells, is on no cell at all."""
_MAX_THRESHOLD: Final = 1000
"""Above any map size in cells, angle in degrees and number of peaks that means something."""


def build_system(
    config: Mapping[str, Any],
    parts: list[Part],
    fingerprint: str,
    images: Mapping[str, Any] | None = None,
) -> PoseSystem:
    """Build the network, its loss and its optimiser as the config names them.

    Args:
        config: The whole config.
        parts: The objects.
        fingerprint: Of the data, for the checkpoint.
        images: What the images are, by split, for the checkpoint.
    """
    network, description = build_untrained(config, parts)
    description = replace(
        description,
        data={
            "name": config["model"]["name"],
            "seed": config["seed"],
            "config": config["data"],
            **({} if images is None else {"images": images}),
        },
        data_fingerprint=fingerprint,
    )
    if config["init_from"] is not None:
        _start_from(network, Path(config["init_from"]))
    return PoseSystem(
        network,
        LOSSES.build(config["model"]["loss"]),
        parts,
        map_geometry(config["maps"], network.stride),
        parse_recovery(description.recovery),
        optimizer_factory(config["optimizer"]),
        scheduler_factory(config["scheduler"]),
        description.to_payload(),
        compile_network=config["compile"],
        symmetry=SymmetryOptions(**config["symmetry"]),
    )


def build_untrained(config: Mapping[str, Any], parts: list[Part]) -> tuple[PoseNetwork, Checkpoint]:
    """Build the chosen network and what it is to be trained for, its data left out.

    Its spec is the chosen components, and what the loss and the objects decide.

    Raises:
        UserError: A choice or a threshold is wrong.
    """
    model = config["model"]
    for name, value in config["maps"].items():  # before the loss, which reads one of them
        check_number(f"maps.{name}", value, _MIN_CELLS, _MAX_THRESHOLD)
    spec = {
        **{name: model[name] for name in ("backbone", "attention", "head")},
        "activation": LOSSES.build(model["loss"]).activation,
        "num_objects": len(parts),
    }
    network = build_network(spec)
    sigma = map_geometry(config["maps"], network.stride).sigma
    for name, value in config["recovery"].items():
        check_number(f"recovery.{name}", value, 0, _MAX_THRESHOLD)
    return network, Checkpoint(
        spec=spec,
        state_dict={},
        parts=parts,
        input_size=tuple(config["data"]["input_size"]),
        stride=network.stride,
        sigma=sigma,
        recovery=vars(parse_recovery({"sigma": sigma, **config["recovery"]})),
    )


def map_geometry(maps: Mapping[str, Any], stride: int) -> MapGeometry:
    """Return how target maps are drawn, from the config's ``maps``."""
    return MapGeometry(stride, maps["sigma"], maps["field_radius"])


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


def build_trainer(
    config: Mapping[str, Any],
    run_dir: Path,
    further: Sequence[Callback] = (),
    trackers: Sequence[Logger] = (),
) -> Trainer:
    """Build Lightning's trainer with the config's callbacks.

    Args:
        config: The whole config.
        run_dir: Folder that everything is written to.
        further: Callbacks besides the config's.
        trackers: Loggers besides the CSV table that is always on.
    """
    options = dict(config["trainer"])
    check_integer("trainer.max_epochs", options["max_epochs"], 1, _MAX_EPOCHS)
    check_integer("trainer.max_steps", options["max_steps"], -1, _MAX_EPOCHS)
    accelerator = options["accelerator"]
    if accelerator == "auto":
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    elif accelerator == "gpu" and torch.cuda.is_available():
        accelerator = "cuda"
    timeout_s = check_number("trainer.ddp_timeout_s", options.pop("ddp_timeout_s"), 1, _MAX_WAIT_S)
    if options["strategy"] == "ddp" or (
        options["strategy"] == "auto" and num_processes(options) > 1
    ):
        options["strategy"] = WatchedDDP(timeout_s)
    options["precision"], reason = choose_precision(options["precision"], accelerator)
    display.console.print(f"precision {options['precision']}: {reason}")
    callbacks = [CALLBACKS.build(node) for node in config["callbacks"].values()]
    if config["ema"] is not None:
        callbacks.append(AveragedWeights(config["ema"]))
    options["profiler"] = make_profiler(options["profiler"], run_dir)
    table = MetricsTable(run_dir / "metrics.csv")
    try:
        return Trainer(
            **{**options, "accelerator": accelerator},
            default_root_dir=run_dir,
            logger=[table, *trackers],
            callbacks=[*callbacks, *further, RunProgress()],
            # A checkpoint is never newer than the table.
            plugins=[AtomicCheckpointIO(prepare=table.write, folder=run_dir)],
            enable_model_summary=False,
            num_sanity_val_steps=0,
            # The DataModule's own sampler knows rank and epoch.
            use_distributed_sampler=False,
        )
    except (MisconfigurationException, TypeError, ValueError) as error:
        raise UserError(
            f"trainer {config['trainer']}, which Lightning refuses: {error}",
            "values of Lightning's Trainer that this machine can run",
            "correct the trainer's options",
        ) from error
