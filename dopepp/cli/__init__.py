"""The console command ``dopepp``; each subcommand imports what it needs when it is called.

To add a command, write a function in a module of its kind and one line in :data:`COMMANDS`.
"""

from __future__ import annotations

import logging
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from dopepp import __version__
from dopepp.cli import calibrate, data, experiment, grasp, network, node, predict
from dopepp.cli.errors import USERS_MISTAKE

COMMANDS: Final = (
    predict.predict,
    network.doctor,
    node.node,
    network.serve,
    experiment.export,
    network.benchmark,
    data.render,
    data.check,
    data.download,
    experiment.compare,
    data.symmetries,
    experiment.release,
)
"""Those whose options are their own, as ``--help`` lists them."""

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


for _entry in (experiment.train, experiment.evaluate):  # Hydra reads what follows, --help too
    app.command(context_settings=experiment.HANDED_ON, add_help_option=False)(_entry)
for _command in COMMANDS:
    is_render = _command.__name__ == "render"
    app.command(cls=data.RenderCommand if is_render else None)(_command)
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(grasp.app, name="grasp")
