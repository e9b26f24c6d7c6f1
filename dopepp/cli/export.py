"""``dopepp export``: a checkpoint for another runtime."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dopepp.cli.errors import report_errors


def export(
    checkpoint: Annotated[Path, typer.Argument(help="best.ckpt of a run, or pretrained/NAME")],
    layout: Annotated[
        str, typer.Option("--format", help="onnx, openvino or safetensors (PyTorch)")
    ] = "onnx",
    precision: Annotated[
        str, typer.Option(help="fp32, fp16 (weights), or int8, calibrated on renders")
    ] = "fp32",
    out: Annotated[
        Path | None, typer.Option(help="file, or folder of OpenVINO; else beside the checkpoint")
    ] = None,
    images: Annotated[
        int, typer.Option(min=20, max=10_000, help="renders to calibrate on, and to measure on")
    ] = 100,
) -> None:
    """Write a checkpoint as one file for onnxruntime or OpenVINO, checked against PyTorch.

    Exit codes: 0 done; 1 the comparison failed or the disk is full; 2 wrong input.
    """
    with report_errors():
        from dopepp.experiment.run.export import export as write

        done = write(checkpoint, layout, precision, out, images)
    size = sum(one.stat().st_size for one in (done.path, *done.path.glob("*")) if one.is_file())
    typer.echo(f"{done.path}, {layout} {precision}, {size:,} bytes")
    typer.echo(f"compared with PyTorch: {done.agreement}")
    if done.export.add_01d:
        rates = ", ".join(f"{key} {100 * rate:.1f} %" for key, rate in done.export.add_01d.items())
        typer.echo(f"ADD-0.1d on {done.export.num_images} validation scenes: {rates}")
    typer.echo("\n".join(done.commands))
