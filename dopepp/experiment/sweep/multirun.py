"""Multirun and SLURM: every job is a row, failed ones too; it ends with a comparison and its table.

A launcher of Hydra's own (``basic``) runs jobs one after another in this process and terminal; any
other one has several at work at a time, so each writes into a file of its own folder.

SLURM starts a requeued job with the same command; so the folder of the run that the command began
is written down under ``OUTPUT_DIR/.slurm``, by job and command, and the job goes on in it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from dopepp.core.files import write_whole
from dopepp.core.yaml import read_yaml
from dopepp.experiment import program

# Hydra makes its hooks before any job, of a single run, too: what they need is imported late.


LOG_FILE: Final = "job.log"
_OWN_PROCESS: Final = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
_STANDARD_OUT_AND_ERROR: Final = (1, 2)


class AnnounceJobs(Callback):
    """Hydra's hook at the start of a multirun: says where to look."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Name the folder, and the file that each job of another process prints to."""
        folder = config.hydra.sweep.dir
        program.say(f"begins in {folder}")
        if is_remote(config.hydra):
            program.say(f"each job prints to {folder}/JOB/{LOG_FILE}")


class CompareJobs(Callback):
    """Hydra's hook at the end of a multirun.

    Hydra skips the hook when a job raises, so a failing job writes ``failed.json`` and returns;
    the sweep then ends non-zero here, after the table.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Say in the sweep's folder what runs there."""
        from dopepp.experiment.results.pages import write_multirun_readme

        write_multirun_readme(Path(str(config.hydra.sweep.dir)), program.command(), {})

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Compare all jobs of the sweep folder; exit with code 1 if one failed."""
        if not compare_jobs(Path(str(config.hydra.sweep.dir)), config):
            raise SystemExit(1)


def compare_jobs(folder: Path, config: DictConfig) -> bool:
    """Compare the jobs that a sweep's folder holds; return whether none has failed."""
    from dopepp.experiment.results import display
    from dopepp.experiment.results.compare import compare_runs
    from dopepp.experiment.results.compared_runs import read_run
    from dopepp.experiment.results.pages import write_multirun_readme
    from dopepp.experiment.results.paper import PaperTable, write_paper_table
    from dopepp.experiment.run.tracking import log_comparison

    table = _node(config, "table")
    jobs = sorted((p for p in folder.iterdir() if p.name.isdigit()), key=lambda p: int(p.name))
    if not jobs:
        return True
    entries = compare_runs([read_run(job) for job in jobs], folder)
    if table is not None:
        write_paper_table(PaperTable.of(table), entries, folder)
    log_comparison(_node(config, "logger"), folder)
    write_multirun_readme(folder, program.command(), {job.name: _state(job) for job in jobs})
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


def is_remote(hydra: Any) -> bool:
    """Return whether the launcher of Hydra's own config runs jobs in other processes."""
    return str(hydra.launcher._target_) != _OWN_PROCESS


@contextmanager
def own_output(path: Path) -> Iterator[None]:
    """Send all that this process and its children print to the end of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    before = [os.dup(number) for number in _STANDARD_OUT_AND_ERROR]
    try:
        with path.open("ab") as stream:
            _redirect([stream.fileno()] * 2)
        yield
    finally:
        _redirect(before)
        for number in before:
            os.close(number)


def _redirect(targets: list[int]) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    for target, number in zip(targets, _STANDARD_OUT_AND_ERROR, strict=True):
        os.dup2(target, number)


def goes_on(config: Mapping[str, Any], run_dir: Path) -> bool:
    """Tell whether a job was interrupted in this very folder, with this very config.

    So does a SLURM job that was queued again, and a search that was started again.
    """
    from dopepp.experiment.results.folder import CONFIG_FILE, LAST_CHECKPOINT
    from dopepp.experiment.run.resume import config_differences

    stored = run_dir / CONFIG_FILE
    if config.get("resume") is not None or not stored.is_file():
        return False
    if not (run_dir / LAST_CHECKPOINT).is_file():
        return False
    before = read_yaml(stored)
    return isinstance(before, dict) and not config_differences(before, config)


_log = logging.getLogger(__name__)


def job_id() -> str | None:
    """Return this job's id, a task's of an array as ``scontrol`` writes it; None outside SLURM."""
    job, array = os.environ.get("SLURM_JOB_ID"), os.environ.get("SLURM_ARRAY_JOB_ID")
    if array is not None:
        job = f"{array}_{os.environ.get('SLURM_ARRAY_TASK_ID', '')}"
    return job if job is not None and re.fullmatch(r"[0-9_]+", job) else None


def requeue() -> str:
    """Ask SLURM to start this job again and say what came of it."""
    job = job_id()
    assert job is not None
    try:
        subprocess.run(
            ["scontrol", "requeue", job],
            check=True,
            capture_output=True,
            text=True,
            timeout=30,
        )
    except (OSError, subprocess.SubprocessError) as error:
        reason = getattr(error, "stderr", None) or error
        return f"SLURM did not requeue job {job}: {' '.join(str(reason).split())}"
    return f"SLURM requeues job {job}"


def remember_run(command: Sequence[str], run_dir: Path) -> None:
    """Write down which folder this job's command has begun; nothing outside SLURM."""
    note = _note(command)
    if note is not None:
        write_whole(note, f"{run_dir.absolute()}\n".encode())


def begun_run(command: Sequence[str]) -> Path | None:
    """Return the folder that this command began before the job was requeued, if it was."""
    note = _note(command)
    restarts = os.environ.get("SLURM_RESTART_COUNT", "0")
    if note is None or restarts == "0" or not note.is_file():
        return None
    run_dir = Path(note.read_text().strip())
    _log.info("job %s was requeued: going on in %s", job_id(), run_dir)
    return run_dir


def _note(command: Sequence[str]) -> Path | None:
    """Return the file for this job and command: a job's script may hold several commands."""
    job = job_id()
    if job is None:
        return None
    given = [text.partition("=")[2] for text in command if text.startswith("output_dir=")]
    digest = hashlib.sha256("\0".join(command).encode()).hexdigest()[:8]
    return Path(given[-1] if given else "outputs", ".slurm", f"{job}-{digest}")
