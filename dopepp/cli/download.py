"""``dopepp download``: a public data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dopepp.cli.errors import resumable


def download(
    name: Annotated[str, typer.Argument(help="voc2007: photos for --backgrounds, 460 MB")],
    out: Annotated[Path, typer.Option(help="folder to keep it in")] = Path("data"),
) -> None:
    """Download a public data set, verify its checksum, and print the folder of its photos."""
    from rich.console import Console
    from rich.progress import DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn

    from dopepp.data.download import download as fetch_and_unpack

    columns = (DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with resumable(), Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=None)
        photos = fetch_and_unpack(
            name, out, lambda there, total: bar.update(task, completed=there, total=total)
        )
    typer.echo(photos)
