"""Multirun: every job is a row, failed ones too; it ends with a comparison and its table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from dopepp.experiment import program

# Hydra makes its hooks before any job, of a single run, too: what they need is imported late.


class CompareJobs(Callback):
    """Hydra's hook at the end of a multirun.

    Hydra skips the hook when a job raises, so a failing job writes ``failed.json`` and returns;
    the sweep then ends non-zero here, after the table.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Say in the sweep's folder what runs there."""
        from dopepp.experiment.results.readme import write_sweep_readme

        write_sweep_readme(Path(str(config.hydra.sweep.dir)), program.command(), {})

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Compare all jobs of the sweep folder; exit with code 1 if one failed."""
        if not compare_jobs(Path(str(config.hydra.sweep.dir)), config):
            raise SystemExit(1)


def compare_jobs(folder: Path, config: DictConfig) -> bool:
    """Compare the jobs that a sweep's folder holds; return whether none has failed."""
    from dopepp.experiment.results import display
    from dopepp.experiment.results.compare import compare_runs
    from dopepp.experiment.results.entries import read_run
    from dopepp.experiment.results.paper_table import PaperTable, write_paper_table
    from dopepp.experiment.results.readme import write_sweep_readme
    from dopepp.experiment.run.tracking import log_comparison

    table = _node(config, "table")
    jobs = sorted((p for p in folder.iterdir() if p.name.isdigit()), key=lambda p: int(p.name))
    if not jobs:
        return True
    entries = compare_runs([read_run(job) for job in jobs], folder)
    if table is not None:
        write_paper_table(PaperTable.of(table), entries, folder)
    log_comparison(_node(config, "logger"), folder)
    write_sweep_readme(folder, program.command(), {job.name: _state(job) for job in jobs})
    display.console.print(f"comparison in {folder}")
    return not any(entry.failure and not entry.pruned for entry in entries)


def _node(config: DictConfig, key: str) -> dict[str, Any] | None:
    """Return a node of a config in plain values, None where there is none."""
    node: Any = OmegaConf.to_container(config[key], resolve=True) if config.get(key) else None
    return node if isinstance(node, dict) else None


def _state(job: Path) -> str:
    """Say how a job stands, by what is in its folder."""
    from dopepp.experiment.results.cost import COST_FILE
    from dopepp.experiment.results.folder import FAILURE_FILE, METRICS_FILE, PRUNED_FILE, read_json

    ends = {FAILURE_FILE: "failed", PRUNED_FILE: "stopped by the search"}
    for name, word in ends.items():
        if (job / name).is_file():
            return f"{word}: {read_json(job / name).get('reason', '')}"
    done = any((job / name).is_file() for name in (METRICS_FILE, COST_FILE))
    return "finished" if done else "unfinished"
