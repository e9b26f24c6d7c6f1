"""``dopepp check``: every defect of a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dopepp.cli.errors import report_errors


def check(
    folder: Annotated[Path, typer.Argument(help="BOP, BOP-WebDataset, NDDS/FAT or YCB-Video")],
    most: Annotated[int, typer.Option(min=0, help="defects that are listed, at most")] = 10_000,
) -> None:
    """Check a data set and list every defect with its file and field, a line each.

    Exit codes: 0 nothing is wrong; 1 something is; 2 there is no data set.
    """
    from dopepp.data.check import check_dataset

    with report_errors():
        report = check_dataset(folder)
    typer.echo("\n".join(report.lines(most)))
    if not report.ok:
        raise typer.Exit(1)
