"""One training run and one evaluation, from a plain config to a run folder."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from dopepp.data.datamodule import PoseDataModule
from dopepp.drawing.curves import save_accuracy_curves
from dopepp.drawing.png import write_png
from dopepp.drawing.sheet import contact_sheet
from dopepp.errors import UserError
from dopepp.experiment import display, record
from dopepp.experiment.compare import compare
from dopepp.experiment.gates import (
    CALLBACKS,
    LOGGERS,
    optimizer_factory,
    scheduler_factory,
)
from dopepp.experiment.hardware import choose_precision, estimate_training_s, keep_freed_memory
from dopepp.experiment.report import FULL_SIZE_COST, Report, full_size_cost, measure
from dopepp.experiment.sources import build_datamodule, build_parts, build_test_source
from dopepp.inference.estimator import PoseEstimator
from dopepp.maps.encode import MapGeometry
from dopepp.models.checkpoint import Checkpoint, load_network, read
from dopepp.models.gate import TARGET, check_integer, check_number
from dopepp.models.spec import LOSSES, build_network
from dopepp.parts.part import Part
from dopepp.recovery.recover import RecoveryOptions
from dopepp.training.loggers import GuardedLogger, MetricsTable
from dopepp.training.saving import AtomicCheckpointIO
from dopepp.training.system import PoseSystem

_log = logging.getLogger(__name__)

PAPER_INPUT_SIZE: Final = (416, 416)
_MAX_EPOCHS: Final = 10**9
_MIN_CELLS: Final = 0.1
"""A peak or disc narrower than this, in cells, is on no cell at all."""
_MAX_THRESHOLD: Final = 1000
"""Above any map size in cells, angle in degrees and number of peaks that means something."""
QUICKSTART: Final = "python train.py model=dopepp data=hybrid experiment=quickstart"


def train(config: dict[str, Any], run_dir: Path) -> Report:
    """Train, then measure the best checkpoint on the test set.

    Args:
        config: The composed and resolved config, plain values.
        run_dir: Folder that everything is written to.

    Raises:
        UserError: A choice, a file or an option is wrong.
    """
    seed = check_integer("seed", config["seed"], 0, 2**32 - 1)
    seed_everything(seed, verbose=False)
    keep_freed_memory()
    display.console.quiet = bool(getattr(rank_zero_only, "rank", 0))  # the first process reports
    parts = build_parts(config["data"])
    datamodule = build_datamodule(config["data"], parts, seed)
    datamodule.check_objects()
    fingerprint = datamodule.fingerprint()
    system = build_system(config, parts, fingerprint)
    resume_from = _resume_path(config["resume"], system)
    trainer = build_trainer(config, run_dir)  # whatever it refuses, nothing is written yet
    display.show_config(config)
    record.write_config(run_dir, config)
    environment = record.environment(seed, fingerprint)
    record.write_json(run_dir / record.VERSIONS_FILE, environment)
    display.show_sources(datamodule.summary())
    _announce_duration(config, system, datamodule, trainer)
    try:
        trainer.fit(system, datamodule=datamodule, ckpt_path=resume_from, weights_only=True)
    except SystemExit as end:
        if isinstance(end.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt(f"go on with resume={run_dir}") from end
        raise
    if not trainer.is_global_zero:
        raise SystemExit(0)  # the first process alone measures and reports
    return _measure_run(config, run_dir, trainer)


def build_system(config: Mapping[str, Any], parts: list[Part], fingerprint: str) -> PoseSystem:
    """Build the network, its loss and its optimiser as the config names them."""
    model, maps = config["model"], config["maps"]
    for group, lowest in (("maps", _MIN_CELLS), ("recovery", 0)):
        for name, value in config[group].items():
            check_number(f"{group}.{name}", value, lowest, _MAX_THRESHOLD)
    loss = LOSSES.build(model["loss"])
    spec = {name: model[name] for name in ("backbone", "attention", "head")}
    spec |= {"activation": loss.activation, "num_objects": len(parts)}
    network = build_network(spec)
    geometry = MapGeometry(network.stride, maps["sigma"], maps["field_radius"])
    recovery = RecoveryOptions(sigma=geometry.sigma, **config["recovery"])
    description = Checkpoint(
        spec=spec,
        state_dict={},
        parts=parts,
        input_size=tuple(config["data"]["input_size"]),
        stride=network.stride,
        sigma=geometry.sigma,
        recovery=vars(recovery),
        data={"name": model["name"], "seed": config["seed"], "config": config["data"]},
        data_fingerprint=fingerprint,
    )
    if config["init_from"] is not None:
        _start_from(network, Path(config["init_from"]))
    return PoseSystem(
        network,
        loss,
        parts,
        geometry,
        recovery,
        optimizer_factory(config["optimizer"]),
        scheduler_factory(config["scheduler"]),
        description.to_payload(),
        compile_network=config["compile"],
    )


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


def build_trainer(config: Mapping[str, Any], run_dir: Path) -> Trainer:
    """Build Lightning's trainer with the config's callbacks and loggers."""
    options = dict(config["trainer"])
    check_integer("trainer.max_epochs", options["max_epochs"], 1, _MAX_EPOCHS)
    check_integer("trainer.max_steps", options["max_steps"], -1, _MAX_EPOCHS)
    accelerator = options["accelerator"]
    if accelerator == "auto":
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    elif accelerator == "gpu" and torch.cuda.is_available():
        accelerator = "cuda"
    options["precision"], reason = choose_precision(options["precision"], accelerator)
    display.console.print(f"precision {options['precision']}: {reason}")
    callbacks = [CALLBACKS.build(node) for node in config["callbacks"].values()]
    loggers: list[Logger] = [MetricsTable(run_dir / "metrics.csv")]
    for node in config.get("logger", {}).values():
        LOGGERS.resolve(node.get(TARGET))  # a wrong name is a mistake, not a logger's failure
        loggers.append(GuardedLogger(partial(LOGGERS.build, node, save_dir=str(run_dir))))
    try:
        return Trainer(
            **{**options, "accelerator": accelerator},
            default_root_dir=run_dir,
            logger=loggers,
            callbacks=[*callbacks, TQDMProgressBar(refresh_rate=10)],
            plugins=[AtomicCheckpointIO()],
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


def _announce_duration(
    config: Mapping[str, Any], system: PoseSystem, datamodule: PoseDataModule, trainer: Trainer
) -> None:
    """Without an accelerator, say how long the run will take and what takes less."""
    if trainer.accelerator.__class__.__name__ != "CPUAccelerator" or not trainer.is_global_zero:
        return
    seconds = estimate_training_s(
        system.network, datamodule, config["trainer"], str(trainer.precision)
    )
    hours = seconds / 3600
    duration = f"{hours:,.1f} hours" if hours >= 1 else f"{seconds / 60:.0f} minutes"
    advice = f"; for a first result in minutes: {QUICKSTART}" if hours >= 1 else ""
    display.console.print(f"no accelerator: about {duration} to finish{advice}")


def _resume_path(resume: str | None, system: PoseSystem) -> Path | None:
    """Return the interrupted run's checkpoint after checking that this run continues it."""
    if resume is None:
        return None
    path = Path(resume) / record.LAST_CHECKPOINT
    if not path.is_file():
        raise UserError(
            f"resume={resume}, which has no {record.LAST_CHECKPOINT}",
            "the folder of an interrupted run",
            "pass that run's folder, or start anew without resume",
        )
    if read(path).spec != system.payload["spec"]:
        raise UserError(
            f"resume={resume}, whose network differs from the chosen one",
            "the model and the number of objects of that run",
            "leave the model as it was, or start anew with init_from",
        )
    return path


def _measure_run(config: Mapping[str, Any], run_dir: Path, trainer: Trainer) -> Report:
    """Measure the best checkpoint of a finished run and write everything down."""
    checkpoints = [one for one in trainer.checkpoint_callbacks if isinstance(one, ModelCheckpoint)]
    path = Path(checkpoints[0].best_model_path) if checkpoints else Path()
    if not path.is_file():
        path = run_dir / record.LAST_CHECKPOINT
    device = trainer.strategy.root_device
    estimator = PoseEstimator.load(path, device)
    details: dict[str, Any] = {"checkpoint": str(path.relative_to(run_dir))}
    if config["model"]["width"] != 1.0:
        cost = full_size_cost(estimator.checkpoint.spec, PAPER_INPUT_SIZE)
        details[FULL_SIZE_COST] = vars(cost)
    return measure_and_record(
        {str(config["model"]["name"]): estimator},
        config["data"],
        int(config["seed"]),
        run_dir,
        num_pictures=12,
        details=details,
    )[0]


def measure_and_record(
    estimators: Mapping[str, PoseEstimator],
    data: Mapping[str, Any],
    seed: int,
    run_dir: Path,
    num_pictures: int,
    details: Mapping[str, Any] | None = None,
) -> list[Report]:
    """Measure estimators on a test set; show and write tables, curves and pictures."""
    last = list(estimators.values())[-1]
    parts = _parts_of(last, data)
    source = build_test_source(data, parts, seed)
    samples = (source.sample(index, 0) for index in range(len(source)))
    reports, tiles = measure(estimators, samples, num_pictures)
    reports[-1].details.update(details or {})
    for report in reports:
        display.show_report(report)
    record.write_json(run_dir / record.METRICS_FILE, reports[-1].to_record())
    curves = {
        f"{report.name} {name}" if len(reports) > 1 else name: errors
        for report in reports
        for name, errors in report.errors.items()
    }
    save_accuracy_curves(run_dir / "auc", curves, title=f"{len(source)} test images")
    if tiles:
        write_png(run_dir / "overlay.png", contact_sheet(tiles))
    if len(reports) > 1:
        compare(reports, run_dir, baseline=reports[0].name)
    display.show_files(run_dir)
    return reports


def _parts_of(estimator: PoseEstimator, data: Mapping[str, Any]) -> list[Part]:
    """Return the estimator's parts with the meshes and points that the test data have for them."""
    names = [part.name for part in estimator.parts]
    if data["root"] is not None and data["objects"] is None:
        data = {**data, "objects": names}
    available = {part.name: part for part in build_parts(data)}
    missing = [name for name in names if name not in available]
    if missing:
        raise UserError(
            f"test data without {', '.join(missing)}, which the checkpoint was trained on",
            ", ".join(names),
            "point data.root or data.parts to data of these objects",
        )
    return [available[name] for name in names]


def evaluate(config: dict[str, Any], run_dir: Path) -> list[Report]:
    """Measure a checkpoint, and a baseline beside it, on its own test set or another one.

    Args:
        config: The composed and resolved evaluation config, plain values.
        run_dir: Folder that everything is written to.

    Raises:
        UserError: A checkpoint, an option or the data are wrong.
    """
    device = config["device"]
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    paths = [path for path in (config["baseline"], config["ckpt_path"]) if path is not None]
    loaded = [PoseEstimator.load(path, device) for path in paths]
    own = loaded[-1].checkpoint
    stored = own.data
    data = config.get("data") or stored.get("config")
    if not isinstance(data, dict):
        raise UserError(
            f"{config['ckpt_path']}, which names no data", "data=… on the command line", "add it"
        )
    record.write_config(run_dir, config)
    environment = record.environment(int(config["seed"]), own.data_fingerprint)
    record.write_json(run_dir / record.VERSIONS_FILE, environment)
    seed = int(stored.get("seed", config["seed"]))
    estimators = dict(zip(_names(loaded), loaded, strict=True))
    return measure_and_record(estimators, data, seed, run_dir, config["num_pictures"])


def _names(loaded: list[PoseEstimator]) -> list[str]:
    """Return the models' names; of two with one name, the first is called the baseline."""
    names = [str(one.checkpoint.data.get("name", "estimate")) for one in loaded]
    if len(set(names)) < len(names):
        names[0] += " (baseline)"
    return names
