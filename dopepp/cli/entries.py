"""What ``dopepp train`` and ``dopepp evaluate`` have in common: Hydra reads what follows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Final

import typer

HANDED_ON: Final = {"ignore_unknown_options": True, "help_option_names": []}
"""Settings of a command whose options, ``--help`` among them, are not its own."""


def _completed(name: str) -> Callable[[typer.Context, str], list[str]]:
    def autocompletion(ctx: typer.Context, incomplete: str) -> list[str]:
        from dopepp.experiment.completion import complete

        return complete(name, ctx.params.get("overrides") or (), incomplete)

    return autocompletion


def _argument(name: str) -> Any:
    text = "KEY=VALUE, GROUP=FILE, and Hydra's own options"
    return typer.Argument(help=text, autocompletion=_completed(name))


def train(overrides: Annotated[list[str] | None, _argument("train")] = None) -> None:
    """Train and measure, as the repository's train.py does: --help lists the choices."""
    _start("train")


def evaluate(overrides: Annotated[list[str] | None, _argument("evaluate")] = None) -> None:
    """Measure a checkpoint, as the repository's evaluate.py does: --help lists the choices."""
    _start("evaluate")


def _start(name: str) -> None:
    from dopepp.experiment.entries import start

    start(name, num_words=2)
