"""``dopepp serve``: poses on a page of this machine's browser."""

from __future__ import annotations

import logging
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Annotated

import typer

from dopepp.cli.errors import report_errors
from dopepp.cli.options import Device


def serve(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="MODEL", help="best.ckpt of a run, or pretrained/NAME")
    ],
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="else the first free one from 7860")
    ] = None,
    refine: Annotated[str | None, typer.Option(help="region: on the picture")] = None,
    device: Device = "cpu",
) -> None:
    """Show a page for this machine's browser: drop a picture, see its poses, download them.

    Nobody else reaches it, and it loads nothing from elsewhere.
    """
    from dopepp.core.errors import UserError, require
    from dopepp.core.interrupts import Interruption, interruptible

    logging.getLogger("httpx").setLevel(
        logging.WARNING
    )  # Gradio asks its own server for signs of life
    with report_errors():
        require("gradio", "dopepp serve", "web")
        if refine not in (None, "region"):
            raise UserError(f"--refine {refine}", "region, or none", "leave it out")
        from dopepp.inference.estimator import PoseEstimator
        from dopepp.inference.page import served

        estimator = PoseEstimator.load(checkpoint, device, refine)
        with suppress(Interruption), interruptible(""), served(estimator, port) as address:
            typer.echo(f"{address} (Ctrl-C ends it)")
            Event().wait()
