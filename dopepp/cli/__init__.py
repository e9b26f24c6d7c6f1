"""The console command ``dopepp``; each subcommand imports what it needs when it is called.

To add a command, write a function in a module of its name and one line in :data:`COMMANDS`.
"""

from __future__ import annotations

import logging
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from dopepp import __version__
from dopepp.cli import (
    benchmark,
    calibrate,
    check,
    compare,
    doctor,
    download,
    entries,
    export,
    grasp,
    node,
    predict,
    release,
    render,
    serve,
    symmetries,
)
from dopepp.cli.errors import USERS_MISTAKE

COMMANDS: Final = (
    entries.train,
    entries.evaluate,
    predict.predict,
    doctor.doctor,
    node.node,
    serve.serve,
    export.export,
    benchmark.benchmark,
    render.render,
    check.check,
    download.download,
    compare.compare,
    symmetries.symmetries,
    release.release,
)
"""As ``--help`` lists them."""

_UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""Of the click that this version of Typer brings along or imports."""


class _OneLine(TyperGroup):
    """Tells a wrong option or a missing argument in one line, as any other mistake."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except _UsageError as error:
            line = " ".join(error.format_message().split())  # type: ignore[attr-defined]
            typer.echo(f"{line.rstrip('.')}; --help lists what there is", err=True)
            raise typer.Exit(USERS_MISTAKE) from error


app = typer.Typer(cls=_OneLine, no_args_is_help=True)


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"dopepp {__version__}")
        raise typer.Exit


@app.callback()
def _configure(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="print it")
    ] = False,
) -> None:
    """6D poses of weakly textured parts, from the CAD file: train, measure, predict, export."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")


for _command in COMMANDS:
    app.command(
        cls=render.RenderCommand if _command is render.render else None,
        context_settings=entries.HANDED_ON
        if _command in (entries.train, entries.evaluate)
        else None,
        add_help_option=_command not in (entries.train, entries.evaluate),
    )(_command)

app.add_typer(calibrate.app, name="calibrate")
app.add_typer(grasp.app, name="grasp")
