"""This process: how the program was started, what it prints, and which of a run's it is."""

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
"""Environment variables that number a run's processes, as torchrun, Lightning, SLURM and LSF do."""


def typed(verb: str) -> str:
    """Return what one types here to ``train`` or to ``evaluate``."""
    script = Path(sys.argv[0]).name in _SCRIPTS
    return f"python {verb}.py" if script else f"dopepp {verb}"


def shown(path: Path) -> str:
    """Return a path as a person would type it here: relative where it is below this folder."""
    path = path.absolute()
    below = path.is_relative_to(Path.cwd())
    return str(path.relative_to(Path.cwd()) if below else path)


def say(line: str) -> None:
    """Print a line at once: Rich's console, which prints the others, takes long to import."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def command() -> list[str]:
    """Return the words of the present command, the program without its folder."""
    return [Path(sys.argv[0]).name, *sys.argv[1:]]


def line(words: Sequence[str]) -> str:
    """Return a command's words as a line to type."""
    return ("python " if words[0].endswith(".py") else "") + shlex.join(words)


def is_first_process() -> bool:
    """Return whether this is the run's only process, or the first of several."""
    return all(os.environ.get(name, "0") in ("", "0") for name in _RANKS)


def configure_logging() -> None:
    """Send messages to the terminal."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)


def quiet_lightning() -> None:
    """Leave out Lightning's messages that only repeat ours; for once it is imported.

    Two warnings go as well: Lightning 2.6 makes a ``LeafSpec`` of every batch, which PyTorch calls
    deprecated since 2.9, and nobody but Lightning can change that; and layers in evaluation mode,
    which are those that a backbone keeps as they are.
    """
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)
    warnings.filterwarnings(
        "ignore", r"Found \d+ module\(s\) in eval mode at the start of training"
    )
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
