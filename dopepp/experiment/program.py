"""Describe this process: its command, its output and its rank."""

from __future__ import annotations

import logging
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Final

_SCRIPTS: Final = ("train.py", "evaluate.py")
_RANKS: Final = ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
"""Environment variables with the rank of a process (torchrun, Lightning, SLURM, LSF)."""


def entry_command(verb: str) -> str:
    """Return the command for ``train`` or ``evaluate`` in the style of the present command."""
    script = Path(sys.argv[0]).name in _SCRIPTS
    return f"python {verb}.py" if script else f"dopepp {verb}"


def relative_path(path: Path) -> str:
    """Return a path relative to the working directory if possible, else absolute."""
    path = path.absolute()
    below = path.is_relative_to(Path.cwd())
    return str(path.relative_to(Path.cwd()) if below else path)


def print_line(line: str) -> None:
    """Print a line immediately, without Rich, whose import is slow."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def command() -> list[str]:
    """Return the words of the present command, without the folder of the program."""
    return [Path(sys.argv[0]).name, *sys.argv[1:]]


def line(words: Sequence[str]) -> str:
    """Return the words of a command as a shell line."""
    return ("python " if words[0].endswith(".py") else "") + shlex.join(words)


def is_first_process() -> bool:
    """Return whether this process has rank 0 in a distributed run, or is the only process."""
    return all(os.environ.get(name, "0") in ("", "0") for name in _RANKS)


def configure_logging() -> None:
    """Send messages to the terminal."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)


def quiet_lightning() -> None:
    """Suppress messages of Lightning that repeat ours, after Lightning has been imported.

    Two warnings are suppressed as well: the use of ``LeafSpec`` in Lightning 2.6, which PyTorch 2.9
    deprecates, and layers in evaluation mode, which are the frozen layers of a backbone.
    """
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)
    warnings.filterwarnings(
        "ignore", r"Found \d+ module\(s\) in eval mode at the start of training"
    )
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
