"""SLURM: a multirun as one job array, through submitit, and a stopped job that is queued again.

SLURM starts a requeued job with the same command; so the folder of the run that the command began
is written down under ``OUTPUT_DIR/.slurm``, by job and command, and the job goes on in it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hydra.core.utils import JobReturn

from dopepp.core.errors import UserError, require
from dopepp.core.files import write_whole
from dopepp.experiment.launch.jobs import Ended, Jobs, Runner

_log = logging.getLogger(__name__)

_OUTPUT_DIR: Final = "output_dir="
_TIMEOUT_S: Final = 30
_ANYWHERE: Final = ("timeout_min", "nodes", "tasks_per_node", "cpus_per_task", "gpus_per_node",
                    "mem_gb", "name")  # fmt: skip
"""What submitit calls by these names on every kind of cluster; the rest is SLURM's own."""


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
            check=True, capture_output=True, text=True, timeout=_TIMEOUT_S,
        )  # fmt: skip
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
    given = [text.removeprefix(_OUTPUT_DIR) for text in command if text.startswith(_OUTPUT_DIR)]
    digest = hashlib.sha256("\0".join(command).encode()).hexdigest()[:8]
    return Path(given[-1] if given else "outputs", ".slurm", f"{job}-{digest}")


@dataclass(frozen=True)
class _Task:
    """A job that submitit can queue again."""

    jobs: Jobs

    def __call__(self, number: int, overrides: list[str]) -> JobReturn:
        return self.jobs.run(number, overrides)

    def checkpoint(self, number: int, overrides: list[str]) -> Any:
        """Near the time limit: the same job once more, which goes on in its folder."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, number, overrides)


def on_slurm(folder: str, cluster: str, max_num_timeout: int, sbatch: Mapping[str, Any]) -> Runner:
    """Return a runner that submits an array and waits for it.

    SLURM's own logs go to the folder. The cluster is ``slurm``, or submitit's ``local``: processes
    of this machine. A job that reaches its time limit is queued again ``max_num_timeout`` times.
    Of ``sbatch``, options by submitit's names, None leaves one to the cluster. A
    :class:`UserError`: submitit is not installed.
    """
    require("submitit", "hydra/launcher=submitit_slurm", "slurm")
    given = {key: value for key, value in sbatch.items() if value is not None}
    named = {key if key in _ANYWHERE else f"slurm_{key}": value for key, value in given.items()}

    def run(jobs: Jobs, overrides: Mapping[int, list[str]]) -> Ended:
        import submitit

        try:
            slurm = {"cluster": cluster, "slurm_max_num_timeout": max_num_timeout}
            executor = submitit.AutoExecutor(folder, **slurm)
            executor.update_parameters(**named)
            handles = executor.map_array(_Task(jobs), *zip(*overrides.items(), strict=True))
        except (RuntimeError, ValueError, NameError, TypeError, OSError) as error:
            raise UserError(
                f"hydra/launcher=submitit_slurm, which this machine or SLURM refuses: {error}",
                "a machine with srun and sbatch, and options of sbatch that the cluster takes",
                "correct hydra.launcher.…, or try it here with hydra.launcher.cluster=local",
            ) from error
        numbers = dict(zip((handle.job_id for handle in handles), overrides, strict=True))
        for handle in submitit.helpers.as_completed(handles):
            try:
                yield numbers[handle.job_id], handle.result()
            except (submitit.core.utils.UncompletedJobError,
                    submitit.core.utils.FailedJobError) as error:  # fmt: skip
                yield numbers[handle.job_id], error

    return run
