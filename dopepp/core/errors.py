"""Ends of a run that are told in one line: a user's mistake, a failure, an interruption.

Choices that need a package of an extra are refused in one line where it is not installed.
"""

from __future__ import annotations

import errno
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Final, NoReturn


class UserError(ValueError):
    """A mistake in an input, a file or an option that its user can correct.

    It states the value with its file and field, the allowed values, and the fix. Entry points print
    it as one line and exit with code 2.
    """

    def __init__(self, got: str, allowed: str, fix: str) -> None:
        self.got, self.allowed, self.fix = got, allowed, fix
        super().__init__(" ".join(f"got {got}; allowed: {allowed}; fix: {fix}".split()))

    def __reduce__(self) -> tuple[type[UserError], tuple[str, str, str]]:
        """Survive the pickling between a loader's worker and its parent."""
        return type(self), (self.got, self.allowed, self.fix)


class RunError(RuntimeError):
    """A run that cannot go on, through no mistake that could have been told at its start.

    Entry points print it as one line and exit with code 1.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(" ".join(reason.split()))


def require(package: str, choice: str, extra: str) -> ModuleSpec:
    """Look up the package that a choice needs; a :class:`UserError` where it is not installed."""
    spec = find_spec(package)
    if spec is None:
        raise UserError(
            f"{choice} without the package {package}",
            f"an installation with the extra {extra}",
            f"pip install 'dopepp[{extra}]', or leave {choice} out",
        )
    return spec


NO_SPACE: Final = (errno.ENOSPC, errno.EDQUOT)  # The disk is full, or the user's share of it
RESUME: Final = "the same command goes on where this one stopped"


class StoppedError(RuntimeError):
    """A job that ended early through nobody's mistake, said in one line."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"{reason}; {RESUME}")


def stopped(error: OSError, root: Path) -> StoppedError:
    """Say in one line what the operating system refused."""
    if error.errno in NO_SPACE:
        return StoppedError(f"no space left for {root}: free some")
    return StoppedError(f"{error.filename or root}: {error.strerror or error}")


class Interruption(KeyboardInterrupt):
    """Ctrl-C, or a scheduler's SIGTERM."""

    def __init__(self, number: int, advice: str = RESUME) -> None:
        super().__init__(f"interrupted; {advice}")
        self.number, self.exit_code = int(number), 128 + number


@contextmanager
def interruptible(advice: str = RESUME) -> Iterator[None]:
    """Raise :class:`Interruption` on SIGINT and SIGTERM while the block runs (main thread only).

    ``advice`` is what the interruption tells to do next.
    """

    def interrupt(number: int, _: FrameType | None) -> NoReturn:
        raise Interruption(number, advice)

    numbers = (signal.SIGINT, signal.SIGTERM)
    kept = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
