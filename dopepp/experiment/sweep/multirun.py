"""Support multiruns and SLURM: compare the jobs of a multirun and resume requeued jobs.

Hydra's launcher ``basic`` runs jobs one after another in this process. Other launchers run several
jobs at a time, so each job prints to a file in its folder.

SLURM starts a requeued job with the same command. Therefore the run folder of each command is
stored under ``OUTPUT_DIR/.slurm``, and a requeued job resumes the run in that folder.
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

from dopepp.core.files import write_file
from dopepp.core.yaml import read_yaml
from dopepp.experiment import program

# Hydra creates callbacks before any job, even in a single run, so slow imports are in functions.

_log = logging.getLogger(__name__)

LOG_FILE: Final = "job.log"
_OWN_PROCESS: Final = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
_STANDARD_OUT_AND_ERROR: Final = (1, 2)


class AnnounceJobs(Callback):
    """Hydra callback that prints the output folders at the start of a multirun."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Print the multirun's folder and, for jobs in other processes, the path of their logs."""
        folder = config.hydra.sweep.dir
        program.print_line(f"begins in {folder}")
        if is_remote(config.hydra):
            program.print_line(f"each job prints to {folder}/JOB/{LOG_FILE}")


class CompareJobs(Callback):
    """Hydra callback that compares the jobs at the end of a multirun.

    Hydra skips it if a job raises. Therefore a failing job writes ``failed.json`` and returns, and
    the callback ends the multirun with exit code 1 after the comparison.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the README of the multirun before any job has run."""
        from dopepp.experiment.results.pages import write_multirun_readme

        write_multirun_readme(Path(str(config.hydra.sweep.dir)), program.command(), {})

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the comparison of all jobs; exit with code 1 if a job failed."""
        if not compare_jobs(Path(str(config.hydra.sweep.dir)), config):
            raise SystemExit(1)


class CheckJobs(Callback):
    """Hydra callback that ends a multirun of ``evaluate.py`` with exit code 1 if a job failed."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Exit with code 1 if any job has written ``failed.json``."""
        from dopepp.experiment.results.folder import FAILURE_FILE

        if any(Path(str(config.hydra.sweep.dir)).glob(f"*/{FAILURE_FILE}")):
            raise SystemExit(1)


def compare_jobs(folder: Path, config: DictConfig, interrupted: bool = False) -> bool:
    """Write the comparison of a multirun's jobs; return whether each has finished or was pruned."""
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
    states = {job.name: _state(job) for job in jobs}
    write_multirun_readme(folder, program.command(), states, interrupted)
    display.console.print(f"comparison in {folder}")
    if interrupted:
        display.console.print(f"to continue, add hydra.sweep.dir={folder} to the command")
    return not any(entry.failure and not entry.pruned for entry in entries)


def _node(config: DictConfig, key: str) -> dict[str, Any] | None:
    """Return a config node as a dictionary; None if it is absent, empty or not a mapping."""
    node: Any = OmegaConf.to_container(config[key], resolve=True) if config.get(key) else None
    return node if isinstance(node, dict) else None


def _state(job: Path) -> str:
    """Return the state of a job from the files in its folder, with the reason for a failure."""
    from dopepp.experiment.results.folder import FAILURE_FILE, PRUNED_FILE, read_end

    name, record = read_end(job)
    early = {FAILURE_FILE: "failed", PRUNED_FILE: "stopped by the search"}
    if name in early:
        return f"{early[name]}: {record.get('reason', '')}"
    return "finished" if name else "unfinished"


def is_remote(hydra: Any) -> bool:
    """Return whether the launcher runs jobs in other processes."""
    return str(hydra.launcher._target_) != _OWN_PROCESS


@contextmanager
def redirected_output(path: Path) -> Iterator[None]:
    """Append stdout and stderr of this process and its children to a file inside the context."""
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


def can_resume(config: Mapping[str, Any], run_dir: Path) -> bool:
    """Return whether the folder holds the last checkpoint of a run with the same config.

    The stored config holds the camera's values instead of its file, and the values that the run
    has chosen; the checks of resuming compare these values again. A trial that was resumed by
    itself has stored no options of the search.
    """
    from dopepp.experiment.config.data_config import AUTOMATIC, with_files
    from dopepp.experiment.config.run_config import is_below
    from dopepp.experiment.results.folder import CONFIG_FILE, LAST_CHECKPOINT
    from dopepp.experiment.run.resume import config_differences

    stored = run_dir / CONFIG_FILE
    if config.get("resume") is not None or not stored.is_file():
        return False
    if not (run_dir / LAST_CHECKPOINT).is_file():
        return False
    before = read_yaml(stored)
    if not isinstance(before, dict):
        return False
    present = {**config, "virtual": with_files(config.get("virtual"))}
    unset = [
        f"{node}.{name}" for node, name in AUTOMATIC if not (present.get(node) or {}).get(name)
    ]
    changes = config_differences(before, present)
    return all(is_below(change.key, ["search", "callbacks.trial", *unset]) for change in changes)


def job_id() -> str | None:
    """Return the id of this SLURM job in the notation of ``scontrol``; None outside SLURM."""
    job, array = os.environ.get("SLURM_JOB_ID"), os.environ.get("SLURM_ARRAY_JOB_ID")
    if array is not None:
        job = f"{array}_{os.environ.get('SLURM_ARRAY_TASK_ID', '')}"
    return job if job is not None and re.fullmatch(r"[0-9_]+", job) else None


def requeue() -> str:
    """Ask SLURM to requeue this job; return a message about the outcome."""
    job = job_id()
    assert job is not None
    try:
        command = ["scontrol", "requeue", job]
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.SubprocessError) as error:
        reason = getattr(error, "stderr", None) or error
        return f"SLURM did not requeue job {job}: {' '.join(str(reason).split())}"
    return f"SLURM requeues job {job}"


def record_run(command: Sequence[str], run_dir: Path) -> None:
    """Store the path of the run folder for this SLURM job and command, if inside SLURM."""
    note = _note(command)
    if note is not None:
        write_file(note, f"{run_dir.absolute()}\n".encode())


def requeued_run(command: Sequence[str]) -> Path | None:
    """Return the folder stored by :func:`record_run` if the SLURM job was requeued, else None."""
    note = _note(command)
    restarts = os.environ.get("SLURM_RESTART_COUNT", "0")
    if note is None or restarts == "0" or not note.is_file():
        return None
    run_dir = Path(note.read_text().strip())
    _log.info("job %s was requeued: continuing in %s", job_id(), run_dir)
    return run_dir


def _note(command: Sequence[str]) -> Path | None:
    """Return the file with the run folder of this SLURM job and command; None outside SLURM."""
    job = job_id()
    if job is None:
        return None
    given = [text.partition("=")[2] for text in command if text.startswith("output_dir=")]
    digest = hashlib.sha256("\0".join(command).encode()).hexdigest()[:8]
    return Path(given[-1] if given else "outputs", ".slurm", f"{job}-{digest}")
