"""``dopepp compare``: runs beside one another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dopepp.cli.errors import report_errors


def compare(
    runs: Annotated[
        list[Path],
        typer.Argument(help="folders of trainings, of evaluations, or of whole multiruns"),
    ],
    out: Annotated[
        Path | None, typer.Option(help="folder; a new one under outputs/compare if left out")
    ] = None,
    baseline: Annotated[
        str | None, typer.Option(help="method that Δ is against; `dope` or the first if left out")
    ] = None,
    pictures: Annotated[
        int, typer.Option(min=0, help="test images that are shown through every model")
    ] = 3,
    table: Annotated[
        Path | None,
        typer.Option(help="conf/experiment/NAME.yaml: the methods in that table's layout, too"),
    ] = None,
) -> None:
    """Compare runs: a table with Δ and how sure it is, training and AUC curves, test pictures.

    Runs that differ in their seed only are one method. Failed and unfinished runs are rows.
    """
    from dopepp.experiment.results.compare import compare_paths

    with report_errors():
        typer.echo(compare_paths(runs, out, baseline, pictures, table))
