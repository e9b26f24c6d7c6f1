"""Multirun: every job is a row, failed ones too, and the sweep ends with one table."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from dopepp.experiment import display, record
from dopepp.experiment.compare import Failure, compare
from dopepp.experiment.report import Report

_log = logging.getLogger(__name__)


class CompareJobs(Callback):
    """Hydra's hook at the end of a multirun.

    Hydra skips the hook when a job raises, so a failing job writes ``failed.json`` and returns;
    the sweep then ends non-zero here, after the table.
    """

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Compare all jobs of the sweep folder.

        Raises:
            SystemExit: With code 1 if a job failed.
        """
        if not compare_jobs(Path(str(config.hydra.sweep.dir))):
            raise SystemExit(1)


def compare_jobs(folder: Path) -> bool:
    """Compare the jobs that a sweep's folder holds; return whether all of them are finished."""
    jobs = sorted((p for p in folder.iterdir() if p.name.isdigit()), key=lambda p: int(p.name))
    results = [read_job(job) for job in jobs]
    if results:
        compare(results, folder, _width_note(jobs))
        display.console.print(f"comparison in {folder}")
    return not any(isinstance(result, Failure) for result in results)


def read_job(job: Path) -> Report | Failure:
    """Read one job's result; what it was overridden with tells jobs of one model apart."""
    name = job_name(job)
    if (job / record.FAILURE_FILE).is_file():
        return Failure(name, str(record.read_json(job / record.FAILURE_FILE)["reason"]))
    if not (job / record.METRICS_FILE).is_file():
        return Failure(name, "unfinished: it left no metrics.json")
    report = Report.from_record(record.read_json(job / record.METRICS_FILE))
    report.name = name
    return report


def job_name(job: Path) -> str:
    """Return the model's name and the overrides in which the sweep's jobs differ."""
    mine = _overrides(job)
    others = [_overrides(other) for other in job.parent.iterdir() if other.name.isdigit()]
    differing = [text for text in mine if not all(text in other for other in others)]
    models = [text.partition("=")[2] for text in mine if text.startswith("model=")]
    name = models[-1] if models else "dopepp"
    rest = [text for text in differing if not text.startswith("model=")]
    return " ".join([name, *rest])


def _overrides(job: Path) -> list[str]:
    path = job / ".hydra" / "overrides.yaml"
    return [str(text) for text in OmegaConf.load(path)] if path.is_file() else []


def _width_note(jobs: list[Path]) -> str:
    """Say it when networks were narrowed, with what they cost at full width."""
    widths = set()
    for job in jobs:
        if (job / record.CONFIG_FILE).is_file():
            widths.add(float(OmegaConf.load(job / record.CONFIG_FILE).model.width))
    narrowed = sorted(width for width in widths if width != 1.0)
    if not narrowed:
        return ""
    factors = ", ".join(f"{width:g}" for width in narrowed)
    return f"The networks were narrowed by model.width={factors}; figures of cost are of these."
