"""``dopepp release``: a checkpoint to hand on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dopepp.cli.errors import report_errors


def release(
    checkpoint: Annotated[Path, typer.Argument(help="best.ckpt of a run, or its tuned copy")],
    name: Annotated[str, typer.Argument(help="what it is called: pretrained/NAME")],
    results: Annotated[
        Path, typer.Option(help="metrics.json of the run, or of an evaluation of this checkpoint")
    ],
    out: Annotated[Path, typer.Option(help="folder of both files")] = Path(),
) -> None:
    """Write a checkpoint as NAME.safetensors, small and without local paths, and a model card."""
    from dopepp.experiment.results.pages import release as write

    with report_errors():
        for path in write(checkpoint, results, name, out):
            typer.echo(f"{path}, {path.stat().st_size:,} bytes")
