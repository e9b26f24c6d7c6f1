"""Log runs to experiment trackers (Weights & Biases and TensorBoard).

A multirun adds a separate run with the comparison. Errors of a tracker do not affect the training
(:class:`~dopepp.training.loggers.GuardedLogger`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

from lightning.pytorch.loggers import WandbLogger

from dopepp.core.errors import UserError
from dopepp.core.files import read_csv
from dopepp.drawing.pictures import read_rgb
from dopepp.experiment.assembly.build_system import LOGGERS
from dopepp.experiment.config.run_config import RunConfig
from dopepp.experiment.results.compare import CURVES_FILE, IMAGES_FILE, LOSS_FILE
from dopepp.experiment.results.compared_runs import TABLE_FILE, overrides_of
from dopepp.experiment.results.frame import shown_rows
from dopepp.experiment.results.paper import TABLE_FILE as PAPER_TABLE_FILE
from dopepp.experiment.results.report import Report
from dopepp.metrics.row import COLUMNS, PoseRow
from dopepp.models.registry import TARGET
from dopepp.training.loggers import GuardedLogger

_IMAGES: Final = ("overlay", "auc", "shading", "shading_examples")
"""Images of a run's test images to log, without ``.png``."""
_COMPARISON: Final = "comparison"

_UNSAID: Final = ("experiment=", "scale=", "logger", "model=", "data=", "resume", "table")
"""Overrides that are omitted in a run's name, because group, model or data state them."""


def open_trackers(config: RunConfig, run_dir: Path) -> AbstractContextManager[list[GuardedLogger]]:
    """Return a context with the trackers of ``config.logger``, which closes them at its end."""
    chosen = [override for override in overrides_of(run_dir) if not override.startswith(_UNSAID)]
    name = " ".join([config.model.name, config.data.name, *chosen])
    group = run_dir.resolve().parent.name if run_dir.name.isdigit() else None
    begun = _interrupted_id(run_dir) if config.resume is not None else None
    return _open(config.logger, run_dir, name, group, "train", begun)


@contextmanager
def _open(
    nodes: Mapping[str, Any] | None,
    folder: Path,
    name: str,
    group: str | None,
    kind: str,
    begun: str | None = None,
) -> Iterator[list[GuardedLogger]]:
    """Build a tracker per node, yield and close them; a node's options override the arguments."""
    trackers = []
    for node in (nodes or {}).values():
        # A wrong name is the user's mistake, not a failure of the tracker.
        target = LOGGERS.resolve(node.get(TARGET))
        options: dict[str, Any] = {"save_dir": str(folder)}
        if issubclass(target, WandbLogger):
            options |= {"name": name, "group": group, "job_type": kind, "version": begun}
        given = {key: value for key, value in options.items() if key not in node}
        trackers.append(GuardedLogger(partial(LOGGERS.build, node, **given)))
    failed = True
    try:
        yield trackers
        failed = False
    finally:
        for tracker in trackers:
            tracker.close(failed)


def _interrupted_id(run_dir: Path) -> str | None:
    """Return the id of the latest Weights & Biases log in a run folder, or None."""
    folders = sorted((run_dir / "wandb").glob("*run-*-*"), key=lambda path: path.stat().st_mtime)
    match = re.fullmatch(r"(?:offline-)?run-\d+_\d+-(\w+)", folders[-1].name) if folders else None
    return match.group(1) if match else None


def log_report(trackers: Sequence[GuardedLogger], report: Report, run_dir: Path) -> None:
    """Log the result of a run: its test measures, those of reference methods, and images."""
    figures = _figures("test", report.rows)
    for reference, rows in report.references.items():
        figures |= _figures(f"reference/{reference}", rows)
    for tracker in trackers:
        tracker.log_summary(figures)
        _send_images(tracker, {f"test/{name}": run_dir / f"{name}.png" for name in _IMAGES})


def _figures(prefix: str, rows: Mapping[str, PoseRow]) -> dict[str, float]:
    """Return the known measures by ``PREFIX/OBJECT/FIELD``, with a mean for several objects."""
    return {
        f"{prefix}/{name}/{column.field}": value
        for name, row in shown_rows(rows).items()
        for column in COLUMNS
        if (value := getattr(row, column.field)) is not None
    }


def log_comparison(nodes: Mapping[str, Any] | None, folder: Path) -> None:
    """Log the comparison of a multirun as a separate run in the group of its jobs."""
    with _open(nodes, folder, _COMPARISON, folder.resolve().name, _COMPARISON) as trackers:
        for tracker in trackers:
            for file in (TABLE_FILE, PAPER_TABLE_FILE):
                rows = read_csv(folder / file)
                if rows:
                    text = (folder / file).with_suffix(".md").read_text()
                    tracker.log_table(Path(file).stem, rows, text)
            names = (CURVES_FILE, IMAGES_FILE, LOSS_FILE, "table_shading.png", "frame_rate.png")
            _send_images(tracker, {Path(name).stem: folder / name for name in names})


def _send_images(tracker: GuardedLogger, paths: Mapping[str, Path]) -> None:
    """Log the image files, by name in the log, that exist and can be read."""
    for name, path in paths.items():
        try:
            image = read_rgb(path) if path.is_file() else None
        except UserError:  # the file is truncated, for example by a full disk
            image = None
        if image is not None:
            tracker.log_image(name, image)
