"""Jobs that a launcher runs in other processes: where they print, and where they go on.

A launcher of Hydra's own (``basic``) runs jobs one after another in this process and terminal; any
other one has several at work at a time, so each writes into a file of its own folder.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from dopepp.core.yaml import read_yaml
from dopepp.experiment.runs import display, record
from dopepp.experiment.runs.resume import config_differences

LOG_FILE: Final = "job.log"
_OWN_PROCESS: Final = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
_STANDARD_OUT_AND_ERROR: Final = (1, 2)


def configure_logging() -> None:
    """Send this package's messages to the terminal, and Lightning's own only from warnings up.

    Lightning's lines say again, and less exactly, what this package says.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)


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
    stored = run_dir / record.CONFIG_FILE
    if config.get("resume") is not None or not stored.is_file():
        return False
    if not (run_dir / record.LAST_CHECKPOINT).is_file():
        return False
    before = read_yaml(stored)
    return isinstance(before, dict) and not config_differences(before, config)


class AnnounceJobs(Callback):
    """Hydra's hook at the start of a multirun: says where to look while other processes work."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Name the file that each job prints to."""
        if is_remote(str(config.hydra.launcher._target_)):
            display.console.print(f"each job prints to {config.hydra.sweep.dir}/JOB/{LOG_FILE}")
