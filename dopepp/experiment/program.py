"""Provide the command, the terminal output and the distributed rank of this process."""

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
    """Return ``python VERB.py`` if this process was started as a script, else ``dopepp VERB``."""
    script = Path(sys.argv[0]).name in _SCRIPTS
    return f"python {verb}.py" if script else f"dopepp {verb}"


def relative_path(path: Path) -> str:
    """Return a path relative to the working directory if it lies inside, else absolute."""
    path = path.absolute()
    below = path.is_relative_to(Path.cwd())
    return str(path.relative_to(Path.cwd()) if below else path)


def print_line(line: str) -> None:
    """Write a line to stdout and flush. Rich is avoided because its import is slow."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def command() -> list[str]:
    """Return the file name of the program and the arguments of this process."""
    return [Path(sys.argv[0]).name, *sys.argv[1:]]


def line(words: Sequence[str]) -> str:
    """Join the words of a command into a quoted shell line, with ``python`` before a script."""
    return ("python " if words[0].endswith(".py") else "") + shlex.join(words)


def is_first_process() -> bool:
    """Return whether this process has rank 0 in a distributed run, or is the only process."""
    return all(os.environ.get(name, "0") in ("", "0") for name in _RANKS)


def configure_logging() -> None:
    """Log messages of level INFO and above to stderr, as plain text."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)


def quiet_lightning() -> None:
    """Suppress Lightning's log messages below WARNING; call after the import of Lightning.

    Two warnings are suppressed as well: Lightning's use of the deprecated ``LeafSpec``, and
    layers in evaluation mode, which are the frozen layers of a backbone.
    """
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)
    warnings.filterwarnings(
        "ignore", r"Found \d+ module\(s\) in eval mode at the start of training"
    )
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
