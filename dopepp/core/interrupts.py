"""How a job ends early: by a signal, or because the machine cannot go on; both can be resumed."""

from __future__ import annotations

import errno
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Final, NoReturn

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
