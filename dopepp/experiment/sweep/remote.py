"""Jobs that a launcher or SLURM runs: where they print, and where they go on.

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
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from dopepp.experiment import program

_log = logging.getLogger(__name__)

LOG_FILE: Final = "job.log"
_OWN_PROCESS: Final = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
_STANDARD_OUT_AND_ERROR: Final = (1, 2)
_RANKS: Final = ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
"""Environment variables that number a run's processes, as torchrun, Lightning, SLURM and LSF do."""


def configure_logging() -> None:
    """Send messages to the terminal."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)


def quiet_lightning() -> None:
    """Leave out Lightning's messages that only repeat ours; for once it is imported.

    Two warnings go as well: Lightning 2.6 makes a ``LeafSpec`` of every batch, which PyTorch calls
    deprecated since 2.9, and nobody but Lightning can change that; and layers in evaluation mode,
    which are those that a backbone keeps as they are.
    """
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)
    warnings.filterwarnings(
        "ignore", r"Found \d+ module\(s\) in eval mode at the start of training"
    )


def is_first_process() -> bool:
    """Tell whether this is the run's only process, or the first of several."""
    return all(os.environ.get(name, "0") in ("", "0") for name in _RANKS)


def is_remote(launcher: str) -> bool:
    """Tell whether a launcher (its class' dotted name) runs jobs in other processes."""
    return launcher != _OWN_PROCESS


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
    from dopepp.core.yaml import read_yaml
    from dopepp.experiment.results.folder import CONFIG_FILE, LAST_CHECKPOINT
    from dopepp.experiment.run.resume import config_differences

    stored = run_dir / CONFIG_FILE
    if config.get("resume") is not None or not stored.is_file():
        return False
    if not (run_dir / LAST_CHECKPOINT).is_file():
        return False
    before = read_yaml(stored)
    return isinstance(before, dict) and not config_differences(before, config)


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
    from dopepp.core.files import write_whole

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


class AnnounceJobs(Callback):
    """Hydra's hook at the start of a multirun: says where to look."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Name the folder, and the file that each job of another process prints to."""
        folder = config.hydra.sweep.dir
        program.say(f"begins in {folder}")
        if is_remote(str(config.hydra.launcher._target_)):
            program.say(f"each job prints to {folder}/JOB/{LOG_FILE}")
