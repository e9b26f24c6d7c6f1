"""How this program was started: as a script of the repository, or as the installed command."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

_SCRIPTS: Final = ("train.py", "evaluate.py")


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
