"""Multirun: every job is a row, failed ones too, and the sweep ends with one comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from dopepp.experiment import display
from dopepp.experiment.compare.compare import compare_runs
from dopepp.experiment.compare.runs import read_run


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
        folder = Path(str(config.hydra.sweep.dir))
        jobs = sorted((p for p in folder.iterdir() if p.name.isdigit()), key=lambda p: int(p.name))
        if not jobs:
            return
        entries = compare_runs([read_run(job) for job in jobs], folder)
        display.console.print(f"comparison in {folder}")
        if any(entry.failure for entry in entries):
            raise SystemExit(1)
