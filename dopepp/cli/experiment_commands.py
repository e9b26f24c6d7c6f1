"""Experiment commands: ``dopepp train``, ``evaluate``, ``compare``, ``export`` and ``release``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer import Argument, Option

HYDRA_OPTIONS: Final = {"ignore_unknown_options": True, "help_option_names": []}
"""Settings of a command that passes all options, ``--help`` included, to Hydra."""


def _overrides(command: str) -> Any:
    """Return the Typer argument for Hydra overrides of a command, with shell completion."""

    def complete(ctx: typer.Context, incomplete: str) -> list[str]:
        from dopepp.experiment.command_line import complete

        return complete(command, ctx.params.get("overrides") or (), incomplete)

    text = "KEY=VALUE, GROUP=CHOICE, and Hydra's own options."
    return Argument(help=text, autocompletion=complete)


def train(overrides: Annotated[list[str] | None, _overrides("train")] = None) -> None:
    """Train and evaluate a network, like train.py of the repository. --help lists the options."""
    from dopepp.experiment.entries import start

    start("train", num_words=2)


def evaluate(overrides: Annotated[list[str] | None, _overrides("evaluate")] = None) -> None:
    """Evaluate a checkpoint, like evaluate.py of the repository. --help lists the options."""
    from dopepp.experiment.entries import start

    start("evaluate", num_words=2)


def compare(
    runs: Annotated[list[Path], Argument(help="Runs, evaluations or multiruns.")],
    out: Annotated[Path | None, Option(help="Target folder (default: in outputs/compare).")] = None,
    baseline: Annotated[
        str | None, Option(help="Reference of Δ (default: dope, or the first).")
    ] = None,
    pictures: Annotated[int, Option(min=0, help="Test images with drawn poses.")] = 3,
    table: Annotated[
        Path | None,
        Option(help="Also print the methods in the layout of this conf/experiment/NAME.yaml"),
    ] = None,
) -> None:
    """Compare runs: a table with differences and confidence intervals, curves and test images.

    Runs that differ only in their seed count as one method. Failed and unfinished runs are listed.
    """
    from dopepp.experiment.results.compare import compare_paths

    typer.echo(compare_paths(runs, out, baseline, pictures, table))


def export(
    checkpoint: Annotated[Path, Argument(help="best.ckpt of a run, or pretrained/NAME.")],
    layout: Annotated[str, Option("--format", help="onnx, openvino or safetensors.")] = "onnx",
    precision: Annotated[str, Option(help="fp32, fp16 (weights) or int8.")] = "fp32",
    out: Annotated[
        Path | None, Option(help="File or OpenVINO folder (default: next to the checkpoint).")
    ] = None,
    images: Annotated[
        int, Option(min=20, max=10_000, help="Number of rendered scenes for int8 and ADD-0.1d.")
    ] = 100,
) -> None:
    """Export a checkpoint for ONNX Runtime or OpenVINO, and verify it against PyTorch.

    Exit codes: 0 done; 1 the outputs differ or the disk is full; 2 wrong input.
    """
    from dopepp.experiment.run.export_checked import export as write

    result = write(checkpoint, layout, precision, out, images)
    files = (result.path, *result.path.glob("*"))
    size = sum(path.stat().st_size for path in files if path.is_file())
    typer.echo(f"{result.path}, {layout} {precision}, {size:,} bytes")
    typer.echo(f"compared with PyTorch: {result.agreement}")
    if result.export.add_01d:
        rates = [f"{part} {100 * rate:.1f} %" for part, rate in result.export.add_01d.items()]
        images = result.export.num_images
        typer.echo(f"ADD-0.1d on {images} validation scenes: {', '.join(rates)}")
    typer.echo("\n".join(result.commands))


def release(
    checkpoint: Annotated[Path, Argument(help="best.ckpt of a run, or its tuned copy.")],
    name: Annotated[str, Argument(help="Name of the release: pretrained/NAME.")],
    results: Annotated[Path, Option(help="metrics.json of the run or of an evaluation.")],
    out: Annotated[Path, Option(help="Target folder.")] = Path(),
) -> None:
    """Write a checkpoint as a small NAME.safetensors without local paths, and a model card."""
    from dopepp.experiment.results.pages import release as write

    for path in write(checkpoint, results, name, out):
        typer.echo(f"{path}, {path.stat().st_size:,} bytes")
