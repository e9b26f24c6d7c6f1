"""How a command ends early: with one line, and 2 for a user's mistake or another code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import typer

from dopepp.core.errors import RunError, UserError

USERS_MISTAKE: Final = 2
FAILED: Final = 1


@contextmanager
def report_errors() -> Iterator[None]:
    """End the command with one line for a user's mistake, or for work that cannot go on."""
    try:
        yield
    except (UserError, RunError) as error:
        typer.echo(str(error), err=True)
        code = USERS_MISTAKE if isinstance(error, UserError) else FAILED
        raise typer.Exit(code) from error


@contextmanager
def resumable(advice: str | None = None) -> Iterator[None]:
    """End the command with one line when it is interrupted or cannot go on, too.

    ``advice`` is what an interruption tells in place of how to resume.
    """
    from dopepp.core.errors import RESUME, Interruption, StoppedError, interruptible

    try:
        with report_errors(), interruptible(advice or RESUME):
            yield
    except (RunError, StoppedError) as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(1) from error
    except Interruption as interruption:
        typer.echo(str(interruption), err=True)
        raise typer.Exit(interruption.exit_code) from interruption
