"""Run the jobs of ``train.py``: train a network from its config and measure its best checkpoint.

To add another ``job=``, write a function of config and run folder, add it to :data:`JOBS` and its
name to :class:`~dopepp.experiment.config.run_config.RunConfig`.
"""

from __future__ import annotations

import logging
import shlex
import shutil
import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch import Callback, Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint

from dopepp.core import extensions
from dopepp.core.errors import Interruption, RunError, UserError
from dopepp.core.pool import in_forked_process
from dopepp.data.datamodule import PoseDataModule
from dopepp.experiment import program
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import build_datamodule
from dopepp.experiment.assembly.build_system import build_system, build_trainer, keep_freed_memory
from dopepp.experiment.assembly.camera_fit import fit_to_camera
from dopepp.experiment.assembly.photos import held_out_photos
from dopepp.experiment.config.data_config import DataConfig
from dopepp.experiment.config.run_config import RunConfig, TrainerConfig
from dopepp.experiment.results import display, pages
from dopepp.experiment.results.conditions import check_masks
from dopepp.experiment.results.cost import measure_cost
from dopepp.experiment.results.folder import (
    LAST_CHECKPOINT,
    OBJECTIVE,
    OVERRIDES_FILE,
    write_config,
    write_environment,
)
from dopepp.experiment.results.paper import PaperTable
from dopepp.experiment.results.recording import measure_and_record, refining
from dopepp.experiment.results.report import Report
from dopepp.experiment.run.described_images import describe_images
from dopepp.experiment.run.evaluate import tune_and_record
from dopepp.experiment.run.lr_finder import find_learning_rate
from dopepp.experiment.run.resume import check_resume, remember_overrides
from dopepp.experiment.run.tracking import log_report, open_trackers
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.refinement.refiner import refine_terms
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.part import Parts
from dopepp.parts.size import LearnedRange
from dopepp.training.loggers import GuardedLogger
from dopepp.training.pose_validation import EarlyStop
from dopepp.training.processes import ProcessDiedError, is_rank_zero
from dopepp.training.pruning import PrunedError, raise_if_pruned
from dopepp.training.refined_progress import RefinedProgress
from dopepp.training.run_checkpoints import FOLDER, check_free_space, newest_checkpoint, saved_step
from dopepp.training.system import PoseSystem
from dopepp.training.throughput import FOLDER as PROFILE
from dopepp.training.throughput import profile_rows
from dopepp.virtual.renderers import survives_fork

_log = logging.getLogger(__name__)


def do_job(config: Mapping[str, Any], run_dir: Path) -> object:
    """Parse the composed config of ``train.py`` and run its job."""
    program.quiet_lightning()
    parsed = RunConfig.of(config)
    extensions.enable(parsed.extensions)
    if parsed.table is not None:
        PaperTable.of(parsed.table)  # reports a mistake before the work begins
    _refuse_parallel_multirun(parsed.trainer)
    return JOBS[parsed.job](parsed, run_dir)


def _refuse_parallel_multirun(trainer: TrainerConfig) -> None:
    """Raise an error if a multirun has several processes, as each would start the sweep again."""
    if not HydraConfig.initialized() or HydraConfig.get().mode != RunMode.MULTIRUN:
        return
    if trainer.num_processes > 1:
        nodes = "" if trainer.num_nodes == 1 else f" trainer.num_nodes={trainer.num_nodes}"
        raise UserError(
            f"trainer.devices={trainer.devices}{nodes} in a multirun",
            "one process per job (each further process would repeat the whole sweep)",
            "set trainer.devices=1 and start one process, or run the jobs one by one",
        )


def run_training(config: RunConfig, run_dir: Path) -> Report:
    """Train, then measure the best checkpoint on the test set.

    Raises:
        PrunedError: A search stopped the training.
        Interruption: A signal ended the training; the message names the last checkpoint.
    """
    readme = pages.RunReadme(config, run_dir)
    try:
        with open_trackers(config, run_dir) as trackers:
            report = _train(config, run_dir, readme, trackers)
    except KeyboardInterrupt as interrupt:
        number = getattr(interrupt, "number", signal.SIGINT)
        step = saved_step(run_dir / LAST_CHECKPOINT)
        saved = f"saved up to step {step} in {LAST_CHECKPOINT}" if step else "nothing saved yet"
        advice = f"{saved}; continue with resume={run_dir}"
        readme.end(pages.INTERRUPTED, advice)
        raise Interruption(number, advice) from interrupt
    except PrunedError as pruned:
        readme.end(pages.PRUNED, str(pruned))
        raise
    except Exception as error:
        readme.end(pages.FAILED, " ".join(str(error).split()) or repr(error))
        raise
    readme.end(pages.FINISHED, report=report)
    return report


def _train(
    config: RunConfig, run_dir: Path, readme: pages.RunReadme, trackers: Sequence[GuardedLogger]
) -> Report:
    if not config.keep_checkpoints and config.resume is not None:
        raise UserError(
            f"resume={config.resume} with keep_checkpoints=false",
            "a run with keep_checkpoints=true",
            "set keep_checkpoints=true, or start a new run without resume",
        )
    seed_everything(config.seed, verbose=False)
    keep_freed_memory()
    # Only rank 0 reports.
    display.console.quiet = not is_rank_zero()
    parts = build_parts(config.data)
    config = fit_to_camera(config, parts)
    if config.tune:
        held_out_photos(config.data, "val")  # reports too few photos before the training
    datamodule = build_datamodule(config.data, parts, config.seed)
    datamodule.check_objects()
    if config.protocols.shading:
        check_masks(datamodule.test_source)
    fingerprint = datamodule.fingerprint()
    sources = {"train": datamodule.train_source, "val": datamodule.val_source}
    sources["test"] = datamodule.test_source

    def describe(parts: Parts) -> tuple[dict[str, Any], dict[str, LearnedRange]]:
        images = {split: describe_images(source) for split, source in sources.items()}
        return images, datamodule.size_ranges(parts)

    # The loader's workers fork this process.
    may_render = survives_fork(config.data.virtual.renderer)
    images, sizes = describe(parts) if may_render else in_forked_process(describe, parts)
    newest = _newest_checkpoint(config)
    # The file with the initial weights of a resumed run may no longer exist.
    initial = config if newest is None else replace(config, init_from=None)
    system = build_system(initial, parts, fingerprint, images, sizes)
    changes = [] if newest is None else check_resume(run_dir, config, newest[1], system.payload)
    # Lightning may reject the options, so the trainer is built before anything is written.
    trainer = build_trainer(config, run_dir, trackers, _progress(config, datamodule))
    weights = system.network.state_dict().values()
    check_free_space(run_dir, sum(value.numel() * value.element_size() for value in weights))
    display.show_config(config.plain)
    for change in changes:
        display.console.print(f"changed since the run began: {change}")
    if is_rank_zero():
        write_config(run_dir, config.plain)
        write_environment(run_dir, config.seed, fingerprint, [str(change) for change in changes])
        if config.resume is not None:
            remember_overrides(run_dir)
        readme.begin()
        for tracker in trackers:
            tracker.log_hyperparams(dict(config.plain))
    display.show_sources(datamodule.summary())
    for line in template_commands(config.data):
        display.console.print(f"available now, without training: {line}", soft_wrap=True)
    _fit(trainer, system, datamodule, None if newest is None else newest[0], run_dir)
    raise_if_pruned(trainer)
    if not trainer.is_global_zero:
        raise SystemExit(0)  # only rank 0 measures and reports
    _print_outcome(trainer, run_dir)
    report = _measure_run(config, parts, run_dir, trainer)
    log_report(trackers, report, run_dir)
    if not config.keep_checkpoints:
        shutil.rmtree(run_dir / FOLDER)
        display.console.print("training and measurement are complete; removing the checkpoints")
    return report


def _progress(config: RunConfig, datamodule: PoseDataModule) -> list[Callback]:
    """Return the callback that measures refined poses in training, if ``refine`` has ``region``."""
    if "region" in (terms := refine_terms(config.refine)):
        return [RefinedProgress(datamodule.val_images, terms, config.stop_at)]
    if config.stop_at is not None:
        raise UserError(
            f"stop_at={config.stop_at:g} with refine={config.refine}",
            "stop_at with refine=region, because refined and verified poses are counted",
            "set refine=region, or leave out stop_at",
        )
    return []


def _fit(
    trainer: Trainer,
    system: PoseSystem,
    datamodule: PoseDataModule,
    resume_from: Path | None,
    run_dir: Path,
) -> None:
    """Train, from the checkpoint ``resume_from`` if set; a RunError states how to resume."""
    try:
        trainer.fit(system, datamodule=datamodule, ckpt_path=resume_from, weights_only=True)
    except SystemExit as end:
        if isinstance(end.__context__, KeyboardInterrupt):
            raise end.__context__ from end
        raise
    except RunError as error:
        if not trainer.is_global_zero and not isinstance(error, ProcessDiedError):
            raise SystemExit(1) from error  # rank 0 reports the common reason
        kept = (run_dir / LAST_CHECKPOINT).is_file()
        advice = f"continue with resume={run_dir}" if kept else "no checkpoint was saved yet"
        raise RunError(f"{error}; {advice}") from error


def _print_outcome(trainer: Trainer, run_dir: Path) -> None:
    """Print why early stopping ended the training, and the running time by function, if any."""
    for stopping in trainer.early_stopping_callbacks:
        if isinstance(stopping, EarlyStop) and stopping.impatient:
            display.console.print(
                f"stopped early after epoch {stopping.stopped_epoch}: {stopping.monitor} has not "
                f"improved in {stopping.wait_count} validations, best {stopping.best_score:.4g}"
            )
    rows = profile_rows(trainer.profiler)  # type: ignore[attr-defined]
    if rows:
        display.show_table(f"running time by function; details in {run_dir / PROFILE}", rows)


def template_commands(data: DataConfig) -> list[str]:
    """Return commands that estimate the parts' poses by templates with the user's camera."""
    virtual, lens = data.virtual, data.virtual.camera
    if data.root is not None or lens is None or virtual.working_distance is None:
        return []
    words = ["--K", *(f"{value:g}" for value in (lens.fx, lens.fy, lens.cx, lens.cy))]
    words += ["--working-distance", ",".join(f"{metres:g}" for metres in virtual.working_distance)]
    if data.unit is not None:
        words += ["--unit", data.unit]
    tilt_deg = getattr(data.preset.turning, "tilt_deg", None)
    if tilt_deg is not None and data.preset.table is None:
        words += ["--tilt", f"{tilt_deg:g}"]
    return [
        shlex.join(["dopepp", "predict", part, "IMAGE", *words, "--save", "out"])
        for part in data.parts
    ]


def _newest_checkpoint(config: RunConfig) -> tuple[Path, Checkpoint] | None:
    """Return the checkpoint to resume from; None for a run that starts from its beginning."""
    resume = config.resume
    if resume is None:
        if config.resume_anyway:
            fix = "add resume=FOLDER, or leave out resume_anyway"
            raise UserError(
                "resume_anyway=true without resume", "both options, or resume alone", fix
            )
        return None
    run_dir = Path(resume)
    newest = newest_checkpoint(run_dir)
    if newest is None and not (run_dir / OVERRIDES_FILE).is_file():
        raise UserError(
            f"resume={resume}, which has no {LAST_CHECKPOINT}",
            "the folder of an interrupted run",
            "set resume to the folder of a run, or start a new run without resume",
        )
    if newest is None:
        display.console.print(f"no checkpoint yet in {resume}: the run starts from its beginning")
    return newest


def _measure_run(config: RunConfig, parts: Parts, run_dir: Path, trainer: Trainer) -> Report:
    """Measure the best checkpoint of a run, after tuning if ``tune`` is set, and record it."""
    savers = [saver for saver in trainer.checkpoint_callbacks if isinstance(saver, ModelCheckpoint)]
    path = Path(savers[0].best_model_path) if savers else Path()
    if not path.is_file():
        path = run_dir / LAST_CHECKPOINT
        _log.warning("the run ended before its first validation: measuring %s", path.name)
    device = trainer.strategy.root_device
    estimator = PoseEstimator.load(path, device)
    if config.tune:
        try:
            tuned = refining(estimator, config.refine, parts)
            path = tune_and_record(tuned, path, parts, config.data, run_dir, config)
        except UserError as error:  # a poorly trained network is measured without tuning
            display.console.print(f"not tuned: {error}")
        else:
            estimator = PoseEstimator.load(path, device)
    details: dict[str, Any] = {"checkpoint": str(path.relative_to(run_dir))}
    score = savers[0].best_model_score if savers else None
    if score is not None and score.isfinite():
        details[OBJECTIVE] = float(score)
    report, _ = measure_and_record(
        {config.model.name: estimator},
        parts,
        config.data,
        run_dir,
        num_shown=12,
        details=details,
        protocols=config.protocols,
        refine=config.refine,
    )
    return report


JOBS: Final[Mapping[str, Callable[[RunConfig, Path], object]]] = {
    "train": run_training,
    "cost": measure_cost,
    "lr_finder": find_learning_rate,
}
