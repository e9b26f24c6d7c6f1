"""Errors that end a run with one line: a user's mistake, a failure or an interruption."""

from __future__ import annotations

import errno
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Final, NoReturn

NO_SPACE: Final = (errno.ENOSPC, errno.EDQUOT)  # full disk, exceeded quota
RESUME: Final = "run the same command again to continue"


class UserError(ValueError):
    """A mistake in an input, a file or an option that the user can correct.

    Args:
        got: The rejected value, with its file and field.
        allowed: The allowed values.
        fix: How to correct the mistake.
    """

    exit_code = 2

    def __init__(self, got: str, allowed: str, fix: str) -> None:
        self.got, self.allowed, self.fix = got, allowed, fix
        super().__init__(" ".join(f"got {got}; allowed: {allowed}; fix: {fix}".split()))

    def __reduce__(self) -> tuple[type[UserError], tuple[str, str, str]]:
        return type(self), (self.got, self.allowed, self.fix)


class RunError(RuntimeError):
    """A failure during a run that no check at its start could have detected."""

    exit_code = 1

    def __init__(self, reason: str) -> None:
        super().__init__(" ".join(reason.split()))


class StoppedError(RunError):
    """A job that stopped early and can be resumed."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"{reason}; {RESUME}")


class Interruption(KeyboardInterrupt):
    """Interruption of a run by Ctrl-C, or by SIGTERM from a scheduler."""

    def __init__(self, number: int, advice: str = RESUME) -> None:
        super().__init__(f"interrupted; {advice}")
        self.number, self.exit_code = int(number), 128 + number


def require(package: str, choice: str, extra: str) -> ModuleSpec:
    """Return the import spec of a package, without importing the package.

    Raises:
        UserError: The package is not installed. The option ``choice`` needs it, and the extra
            ``extra`` of dopepp installs it.
    """
    spec = find_spec(package)
    if spec is None:
        raise UserError(
            f"{choice} without the package {package}",
            f"an installation with the extra {extra}",
            f"pip install 'dopepp[{extra}]', or leave out {choice}",
        )
    return spec


def check_choice(option: str, value: str, allowed: Iterable[str]) -> None:
    """Raise a UserError if a command-line option, e.g. ``--unit``, has no allowed value."""
    if value not in allowed:
        fix = f"pass {option} with one of these values"
        raise UserError(f"{option} {value}", ", ".join(allowed), fix)


def system_failure(error: OSError, path: Path) -> str:
    """Return a message for a failed file operation on a path, with advice if the disk is full."""
    if error.errno in NO_SPACE:
        return f"no space left for {path}: free some disk space"
    return f"{error.filename or path}: {error.strerror or error}"


@contextmanager
def interruptible(advice: str = RESUME) -> Iterator[None]:
    """Raise :class:`Interruption` with advice on SIGINT and SIGTERM in the block (main thread)."""

    def interrupt(number: int, _: FrameType | None) -> NoReturn:
        raise Interruption(number, advice)

    with _handled_by(interrupt):
        yield


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Postpone SIGINT and SIGTERM to the end of the block (main thread)."""
    numbers: list[int] = []
    with _handled_by(lambda number, _: numbers.append(number)):
        yield
    for number in numbers:
        signal.raise_signal(number)


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Pass SIGINT and SIGTERM in the block to a handler."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in previous.items():
            signal.signal(number, earlier)
