"""Suggest a learning rate (``job=lr_finder``); the trained weights are discarded.

Lightning's tuner runs the sweep: a short training whose rate grows from step to step (Smith,
"Cyclical Learning Rates for Training Neural Networks", WACV 2017, section 3.3). This module derives
the suggestion. Lightning's own suggestion uses the slope over the rate instead of its logarithm, so
that suggestion is always near the beginning of the sweep, and the running mean lags behind.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

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
from dopepp.experiment.assembly.build_sources import build_datamodule
from dopepp.experiment.assembly.build_system import build_system, build_trainer
from dopepp.experiment.assembly.camera_fit import fit_to_camera
from dopepp.experiment.config.run_config import LearningRateConfig, RunConfig
from dopepp.experiment.results import display
from dopepp.experiment.results.folder import write_config, write_environment
from dopepp.experiment.results.pages import write_run_readme
from dopepp.training.system import PoseSystem

TABLE_FILE: Final = "lr_finder.csv"
IMAGE_FILE: Final = "lr_finder.png"

_MIN_STEPS: Final = 10
_MOST: Final = 10**6  # maximum number of epochs; the number of steps ends the sweep

_SMOOTHING: Final = 0.05  # standard deviation of the smoothing, share of the sweep
_SKIPPED: Final = 0.1  # share of the sweep in which optimiser and batch norm settle
_MIN_FALL: Final = 0.05  # minimum relative fall of the loss for a suggestion

Steps = Float[np.ndarray, "steps"]


class Suggestion(NamedTuple):
    """Learning rates: the suggestion, where the loss falls fastest, and that of the lowest loss."""

    steepest: float
    lowest: float


def find_learning_rate(config: RunConfig, run_dir: Path) -> Suggestion | None:
    """Train with a growing learning rate; print, write and return a suggested rate, if any.

    The sweep uses the chosen optimiser without schedule, validation and checkpoints.
    """
    if config.resume is not None:
        raise UserError(
            f"resume={config.resume} with job=lr_finder",
            "init_from=CHECKPOINT, or neither",
            "leave out resume",
        )
    seed_everything(config.seed, verbose=False)
    parts = build_parts(config.data)
    config = fit_to_camera(config, parts)
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
    write_run_readme(run_dir, f"Learning rate of {config.model.name}")
    return suggestion


def _short_training(config: RunConfig) -> RunConfig:
    """Return a config for training on one device without schedule, validation and callbacks."""
    lightning = {
        **config.trainer.lightning,
        "check_val_every_n_epoch": _MOST,
        "val_check_interval": None,
        "enable_checkpointing": False,
    }
    trainer = replace(config.trainer, devices=1, num_nodes=1, strategy="auto", lightning=lightning)
    trainer = replace(trainer, max_steps=-1, max_epochs=_MOST)
    return replace(config, trainer=trainer, scheduler={}, callbacks={}, ema=None)


def _sweep(
    trainer: Trainer, system: PoseSystem, datamodule: PoseDataModule, options: LearningRateConfig
) -> tuple[Steps, Steps]:
    """Train with rising learning rates; return rate and loss of each step with a finite loss."""
    batch_losses: list[float] = []

    def store_loss(module: object, inputs: object, output: tuple[Tensor, object]) -> None:
        # Lightning stores only a running mean and would continue with infinite losses.
        batch_losses.append(float(output[0].detach()))
        if not math.isfinite(batch_losses[-1]):
            trainer.should_stop = True

    with system.loss.register_forward_hook(store_loss):
        sweep = Tuner(trainer).lr_find(
            system,
            datamodule=datamodule,
            min_lr=options.min_lr,
            max_lr=options.max_lr,
            num_training=options.num_steps,
            update_attr=False,
        )
    assert sweep is not None, "Lightning skips the sweep only with fast_dev_run"
    per_step = trainer.accumulate_grad_batches
    count = min(len(sweep.results["lr"]), len(batch_losses) // per_step)
    losses = np.array(batch_losses[: count * per_step]).reshape(count, per_step).mean(axis=1)
    count = int(np.isfinite(losses).cumprod().sum())
    return np.array(sweep.results["lr"][:count]), losses[:count]


def suggest(rates: Steps, losses: Steps) -> Suggestion | None:
    """Suggest a rate from ascending rates and their losses; None if the loss falls by under 5 %."""
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
    """Return a Gaussian moving average (σ: 5 % of the length), normalised at the ends."""
    position = np.arange(len(values))
    width = max(1.0, _SMOOTHING * len(values))
    weight = np.exp(-0.5 * ((position[:, None] - position) / width) ** 2)
    return np.asarray(weight @ values / weight.sum(axis=1))


def _report(rates: Steps, losses: Steps, run_dir: Path) -> Suggestion | None:
    """Write the sweep's table and curve, print the suggested rate and return it."""
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
        steepest, lowest = suggestion.steepest, suggestion.lowest
        axes.axvline(steepest, color="C3", label=f"falls fastest: {steepest:.2g}")
        axes.axvline(lowest, color="C7", linestyle=":", label=f"lowest: {lowest:.2g}")
        axes.legend()
    write_png(run_dir / IMAGE_FILE, figure_image(figure))
    text = (
        "the loss does not fall anywhere in the sweep: widen lr_finder.min_lr … max_lr, or check "
        "the data"
        if suggestion is None
        else f"suggested optimizer.lr={suggestion.steepest:.2g}, where the loss falls fastest; "
        f"the lowest loss is at {suggestion.lowest:.2g}"
    )
    display.console.print(f"{text}; {run_dir / IMAGE_FILE}")
    return suggestion
