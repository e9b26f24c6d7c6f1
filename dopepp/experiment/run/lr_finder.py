"""``job=lr_finder``: which learning rate to begin with; nothing is kept of what is trained.

Lightning's tuner makes the sweep: a short training whose rate grows from step to step (Smith,
"Cyclical Learning Rates for Training Neural Networks", WACV 2017, section 3.3). The suggestion is
read off here. Lightning's own takes the steepest slope over the rate instead of over its logarithm,
so it is always near the sweep's beginning, and its running mean lags by up to fifty steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.tuner.tuning import Tuner
from torch import Tensor

from dopepp.core.errors import RunError, UserError
from dopepp.core.files import write_csv, write_png
from dopepp.data.datamodule import PoseDataModule
from dopepp.drawing.curves import figure_image, figure_with_axes
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import build_datamodule, fitted_to_camera
from dopepp.experiment.assembly.build_system import build_system, build_trainer
from dopepp.experiment.config.run_config import LearningRateConfig, RunConfig
from dopepp.experiment.results import display
from dopepp.experiment.results.folder import write_config, write_environment
from dopepp.experiment.results.pages import write_job_readme
from dopepp.training.system import PoseSystem

TABLE_FILE: Final = "lr_finder.csv"
PICTURE_FILE: Final = "lr_finder.png"

_MIN_STEPS: Final = 10
_MOST: Final = 10**6
"""Epochs, since the steps end the sweep."""

_SMOOTHING: Final = 0.05
"""Standard deviation of the smoothing, as a share of the sweep: noise of single batches goes, the
valley stays."""
_SKIPPED: Final = 0.1
"""Share of the sweep at its beginning in which nothing is looked for: the optimiser's averages and
batch norm's statistics are still settling."""
_MIN_FALL: Final = 0.05
"""A loss that falls by less than this share in the whole sweep says nothing."""


Steps = Float[np.ndarray, "steps"]


@dataclass(frozen=True)
class Suggestion:
    """What a sweep says: the rate at which the loss falls fastest, which is the one to begin with.

    At ``lowest`` the loss is lowest; it diverges somewhere above.
    """

    steepest: float
    lowest: float


def find_learning_rate(config: RunConfig, run_dir: Path) -> Suggestion | None:
    """Train with a rate that grows from step to step; print, write and return what it suggests.

    The chosen optimiser with its other settings; no schedule, no validation, no checkpoint. A
    :class:`UserError`: a choice is wrong; a ``RunError``: the loss is not finite from the start.
    """
    if config.resume is not None:
        raise UserError(
            f"resume={config.resume} with job=lr_finder", "init_from=…, or neither", "leave it"
        )
    seed_everything(config.seed, verbose=False)
    parts = build_parts(config.data)
    config = fitted_to_camera(config, parts)
    datamodule = build_datamodule(config.data, parts, config.seed)
    datamodule.check_objects()
    short = _short_training(config)
    system = build_system(short, parts, "")
    trainer = build_trainer(short, run_dir)
    write_config(run_dir, config.plain)
    write_environment(run_dir, config.seed, "")
    rates, losses = _sweep(trainer, system, datamodule, config.lr_finder)
    if len(rates) < _MIN_STEPS:
        raise RunError(
            f"the loss diverged after {len(rates)} steps at a learning rate of "
            f"{config.lr_finder.min_lr:g}; set a smaller lr_finder.min_lr"
        )
    suggestion = _report(rates, losses, run_dir)
    write_job_readme(run_dir, f"Learning rate of {config.model.name}")
    return suggestion


def _short_training(config: RunConfig) -> RunConfig:
    """Return the config without all that the sweep does not need, validations among it."""
    trainer = replace(
        config.trainer,
        max_steps=-1,
        max_epochs=_MOST,
        devices=1,
        num_nodes=1,
        strategy="auto",
        lightning={
            **config.trainer.lightning,
            "check_val_every_n_epoch": _MOST,
            "val_check_interval": None,
            "enable_checkpointing": False,
        },
    )
    return replace(config, trainer=trainer, scheduler={}, callbacks={}, ema=None)


def _sweep(
    trainer: Trainer, system: PoseSystem, datamodule: PoseDataModule, options: LearningRateConfig
) -> tuple[Steps, Steps]:
    """Return rate and loss of every step up to where the loss diverges or is not finite."""
    passes: list[float] = []

    def note(module: object, inputs: object, output: tuple[Tensor, object]) -> None:
        # Lightning keeps its running mean alone, and would go on with losses that are not finite.
        passes.append(float(output[0].detach()))
        if not math.isfinite(passes[-1]):
            trainer.should_stop = True

    with system.loss.register_forward_hook(note):
        sweep = Tuner(trainer).lr_find(
            system,
            datamodule=datamodule,
            min_lr=options.min_lr,
            max_lr=options.max_lr,
            num_training=options.num_steps,
            update_attr=False,
        )
    assert sweep is not None, "Lightning skips the sweep in its fast_dev_run alone"
    per_step = trainer.accumulate_grad_batches
    count = min(len(sweep.results["lr"]), len(passes) // per_step)
    losses = np.array(passes[: count * per_step]).reshape(count, per_step).mean(axis=1)
    count = int(np.isfinite(losses).cumprod().sum())
    return np.array(sweep.results["lr"][:count]), losses[:count]


def suggest(rates: Steps, losses: Steps) -> Suggestion | None:
    """Read a rate off a sweep: rates ascend, losses are finite; None if the loss did not fall."""
    first = int(_SKIPPED * len(rates))
    smoothed = smooth(losses)[first:]
    if len(smoothed) < 3:
        return None
    bottom = int(np.argmin(smoothed))
    fall = smoothed[: bottom + 1].max() - smoothed[bottom]
    if bottom < 2 or fall < _MIN_FALL * abs(smoothed[: bottom + 1].max()):
        return None
    slope = np.gradient(smoothed, np.log(rates[first:]))[:bottom]
    steepest = int(np.argmin(slope))
    return Suggestion(float(rates[first + steepest]), float(rates[first + bottom]))


def smooth(values: Steps) -> Steps:
    """Return a Gaussian mean over neighbours, of what there is near the ends."""
    position = np.arange(len(values))
    width = max(1.0, _SMOOTHING * len(values))
    weight = np.exp(-0.5 * ((position[:, None] - position) / width) ** 2)
    return np.asarray(weight @ values / weight.sum(axis=1))


def _report(rates: Steps, losses: Steps, run_dir: Path) -> Suggestion | None:
    """Write table and picture, and print the line that a person came for."""
    smoothed = smooth(losses)
    rows = [
        {"step": step, "learning_rate": rate, "loss": loss, "smoothed_loss": mean}
        for step, (rate, loss, mean) in enumerate(zip(rates, losses, smoothed, strict=True))
    ]
    write_csv(run_dir / TABLE_FILE, rows)
    suggestion = suggest(rates, losses)
    figure, axes = figure_with_axes("learning rate", "training loss")
    axes.plot(rates, losses, alpha=0.3)
    axes.plot(rates, smoothed, color="C0")
    axes.set_xscale("log")
    axes.set_ylim(min(losses.min(), 0.95 * smoothed.min()), 1.1 * smoothed.max())
    if suggestion is not None:
        axes.axvline(
            suggestion.steepest, color="C3", label=f"falls fastest: {suggestion.steepest:.2g}"
        )
        axes.axvline(
            suggestion.lowest, color="C7", linestyle=":", label=f"lowest: {suggestion.lowest:.2g}"
        )
        axes.legend()
    write_png(run_dir / PICTURE_FILE, figure_image(figure))
    text = (
        "the loss does not fall anywhere in the sweep: widen lr_finder.min_lr … max_lr, or look at "
        "the data"
        if suggestion is None
        else f"suggested optimizer.lr={suggestion.steepest:.2g}, where the loss falls fastest; "
        f"it is lowest at {suggestion.lowest:.2g}"
    )
    display.console.print(f"{text}; {run_dir / PICTURE_FILE}")
    return suggestion
