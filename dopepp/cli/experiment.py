"""Experiments: ``dopepp train``, ``evaluate``, ``compare``, ``export`` and ``release``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from dopepp.cli.errors import report_errors

HANDED_ON: Final = {"ignore_unknown_options": True, "help_option_names": []}
"""Settings of a command whose options, ``--help`` among them, are not its own."""


def _completed(name: str) -> Callable[[typer.Context, str], list[str]]:
    def autocompletion(ctx: typer.Context, incomplete: str) -> list[str]:
        from dopepp.experiment.command_line import complete

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
        from dopepp.experiment.run.export_checked import export as write

        done = write(checkpoint, layout, precision, out, images)
    size = sum(one.stat().st_size for one in (done.path, *done.path.glob("*")) if one.is_file())
    typer.echo(f"{done.path}, {layout} {precision}, {size:,} bytes")
    typer.echo(f"compared with PyTorch: {done.agreement}")
    if done.export.add_01d:
        rates = ", ".join(f"{key} {100 * rate:.1f} %" for key, rate in done.export.add_01d.items())
        typer.echo(f"ADD-0.1d on {done.export.num_images} validation scenes: {rates}")
    typer.echo("\n".join(done.commands))


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
