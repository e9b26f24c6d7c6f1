"""SLURM's requeued jobs: where they go on.

SLURM starts a requeued job with the same command; so the folder of the run that the command began
is written down under ``OUTPUT_DIR/.slurm``, by job and command, and the job goes on in it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

from dopepp.core.files import write_whole

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
            check=True, capture_output=True, text=True, timeout=30,
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
    given = [text.partition("=")[2] for text in command if text.startswith("output_dir=")]
    digest = hashlib.sha256("\0".join(command).encode()).hexdigest()[:8]
    return Path(given[-1] if given else "outputs", ".slurm", f"{job}-{digest}")
