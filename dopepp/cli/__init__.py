"""The console command ``dopepp``. Each subcommand imports its dependencies when it is called.

To add a command, write a function in the module of its kind and add it to :data:`COMMANDS`.
"""

from __future__ import annotations

import logging
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from dopepp import __version__
from dopepp.cli import (
    calibrate,
    data_commands,
    experiment_commands,
    grasp,
    network_commands,
    node,
    predict,
)
from dopepp.core.errors import Interruption, RunError, UserError

COMMANDS: Final = (
    predict.predict,
    network_commands.doctor,
    node.node,
    network_commands.serve,
    experiment_commands.export,
    network_commands.benchmark,
    data_commands.render,
    data_commands.check,
    data_commands.download,
    experiment_commands.compare,
    data_commands.symmetries,
    experiment_commands.release,
)
"""Commands whose arguments Typer parses, unlike Hydra's overrides, in the order of ``--help``."""

_UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""Class of usage errors of the click version that Typer bundles or imports."""


class _OneLineErrors(TyperGroup):
    """Group of commands that reports every expected error in one line on stderr."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command; exit with the code of its error."""
        try:
            return super().invoke(ctx)
        except _UsageError as error:
            line = " ".join(error.format_message().split())  # type: ignore[attr-defined]
            if not line:  # the help was printed instead
                raise
            line, code = f"{line.rstrip('.')}; see --help", UserError.exit_code
        except (UserError, RunError, Interruption) as error:
            line, code = str(error), error.exit_code
        typer.echo(line, err=True)
        raise typer.Exit(code)


app = typer.Typer(cls=_OneLineErrors, no_args_is_help=True)


def _show_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(f"dopepp {__version__}")
        raise typer.Exit


@app.callback()
def _configure(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Estimate 6D poses of weakly textured parts from their CAD files."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")


for _entry in (experiment_commands.train, experiment_commands.evaluate):
    app.command(context_settings=experiment_commands.HYDRA_OPTIONS, add_help_option=False)(_entry)
for _command in COMMANDS:
    is_render = _command is data_commands.render
    app.command(cls=data_commands.RenderCommand if is_render else None)(_command)
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(grasp.app, name="grasp")
