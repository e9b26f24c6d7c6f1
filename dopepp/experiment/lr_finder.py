"""``job=lr_finder``: which learning rate to begin with; nothing is kept of what is trained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from lightning.pytorch import seed_everything

from dopepp.core.errors import RunError, UserError
from dopepp.core.files import write_png, write_whole
from dopepp.drawing.curves import figure_image, figure_with_axes
from dopepp.experiment.build.sources import build_datamodule, build_parts
from dopepp.experiment.build.system import build_system, build_trainer
from dopepp.experiment.config.run import RunConfig
from dopepp.experiment.reports.tables import csv_text
from dopepp.experiment.runs import display, record
from dopepp.experiment.runs.readme import write_job_readme
from dopepp.training.callbacks.rate_sweep import RateSweep, Suggestion, exponential, smooth, suggest

TABLE_FILE: Final = "lr_finder.csv"
PICTURE_FILE: Final = "lr_finder.png"

_MIN_STEPS: Final = 10
_MOST: Final = 10**6
"""Epochs, since the steps end the sweep."""


def find_learning_rate(config: RunConfig, run_dir: Path) -> Suggestion | None:
    """Train with a rate that grows from step to step; print, write and return what it suggests.

    The chosen optimiser with its other settings; no schedule, no validation, no checkpoint.

    Raises:
        UserError: A choice is wrong.
        RunError: The loss is not finite from the start.
    """
    first, last = config.lr_finder.min_lr, config.lr_finder.max_lr
    if config.resume is not None:
        raise UserError(
            f"resume={config.resume} with job=lr_finder", "init_from=…, or neither", "leave it"
        )
    seed_everything(config.seed, verbose=False)
    parts = build_parts(config.data)
    datamodule = build_datamodule(config.data, parts, config.seed)
    datamodule.check_objects()
    short = _short_training(config, first)
    system = build_system(short, parts, "")
    system.make_scheduler = exponential(first, last)
    sweep = RateSweep()
    trainer = build_trainer(short, run_dir, [sweep])
    record.write_config(run_dir, config.plain)
    record.write_environment(run_dir, config.seed, "")
    trainer.fit(system, datamodule=datamodule)
    if len(sweep.rates) < _MIN_STEPS:
        raise RunError(
            f"the loss diverged after {len(sweep.rates)} steps at a learning rate of {first:g}; "
            "set a smaller lr_finder.min_lr"
        )
    found = _report(sweep, run_dir)
    write_job_readme(run_dir, f"Learning rate of {config.model.name}")
    return found


def _short_training(config: RunConfig, rate: float) -> RunConfig:
    """Return the config of a training that begins at a rate, without all that is not needed."""
    trainer = replace(
        config.trainer,
        max_steps=config.lr_finder.num_steps,
        max_epochs=_MOST,
        devices=1,
        num_nodes=1,
        strategy="auto",
        lightning={
            **config.trainer.lightning,
            "limit_val_batches": 0,
            "enable_checkpointing": False,
        },
    )
    optimizer = {**config.optimizer, "lr": rate}
    return replace(
        config, trainer=trainer, optimizer=optimizer, scheduler={}, callbacks={}, ema=None
    )


def _report(sweep: RateSweep, run_dir: Path) -> Suggestion | None:
    """Write table and picture, and print the line that a person came for."""
    rates, losses = np.array(sweep.rates), np.array(sweep.losses)
    smoothed = smooth(losses)
    rows = [
        {"step": step, "learning_rate": rate, "loss": loss, "smoothed_loss": mean}
        for step, (rate, loss, mean) in enumerate(zip(rates, losses, smoothed, strict=True))
    ]
    write_whole(run_dir / TABLE_FILE, csv_text(rows).encode())
    found = suggest(rates, losses)
    figure, axes = figure_with_axes("learning rate", "training loss")
    axes.plot(rates, losses, alpha=0.3)
    axes.plot(rates, smoothed, color="C0")
    axes.set_xscale("log")
    axes.set_ylim(min(losses.min(), 0.95 * smoothed.min()), 1.1 * smoothed[: len(losses)].max())
    if found is not None:
        axes.axvline(found.steepest, color="C3", label=f"falls fastest: {found.steepest:.2g}")
        axes.axvline(found.lowest, color="C7", linestyle=":", label=f"lowest: {found.lowest:.2g}")
        axes.legend()
    write_png(run_dir / PICTURE_FILE, figure_image(figure))
    if found is None:
        display.console.print(
            "the loss does not fall anywhere in the sweep: widen lr_finder.min_lr … max_lr, or "
            f"look at the data; {run_dir / PICTURE_FILE}"
        )
    else:
        display.console.print(
            f"suggested optimizer.lr={found.steepest:.2g}, where the loss falls fastest; it is "
            f"lowest at {found.lowest:.2g}; {run_dir / PICTURE_FILE}"
        )
    return found
