"""Multirun: every job is a row, failed ones too; it ends with a comparison and its table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from dopepp.experiment import display
from dopepp.experiment.compare.compare import compare_runs
from dopepp.experiment.compare.runs import read_run
from dopepp.experiment.paper_table import PaperTable, write_paper_table


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
        if config.get("table") is not None:
            table: Any = OmegaConf.to_container(config.table, resolve=True)
            write_paper_table(PaperTable.of(table), entries, folder)
        display.console.print(f"comparison in {folder}")
        if any(entry.failure and not entry.pruned for entry in entries):
            raise SystemExit(1)
