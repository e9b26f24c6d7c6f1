"""Data sets: ``dopepp render``, ``check``, ``download`` and ``symmetries``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from dopepp.cli.errors import report_errors, resumable
from dopepp.cli.options import Unit


class RenderCommand(TyperCommand):
    """Names every preset in its help; they are read only for it."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help."""
        from dopepp.virtual.presets import PRESETS

        (preset,) = (one for one in self.params if one.name == "preset")
        preset.help = ", ".join(PRESETS)  # type: ignore[attr-defined]
        super().format_help(ctx, formatter)


def render(
    parts: Annotated[
        list[str],
        typer.Argument(
            help="mesh files (STL, OBJ, PLY, GLB, 3MF, OFF), built-in parts, or NAME=FILE"
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder of the data set; with --preview also a .png")],
    num: Annotated[int | None, typer.Option("-n", help="number of images")] = None,
    unit: Unit = None,
    layout: Annotated[str, typer.Option("--format", help="bop, ndds or webdataset")] = "bop",
    preset: Annotated[str, typer.Option(help="what the scenes are like")] = "paper",
    size: Annotated[
        str | None,
        typer.Option(
            help="WIDTHxHEIGHT (or W,H), pixels; the field of view along the shorter side stays, "
            "and pixels are square; the preset's if left out"
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(help="file of the camera whose pictures these are (ROS, OpenCV, BOP, …)"),
    ] = None,
    working_distance: Annotated[
        str | None, typer.Option(help="NEAREST,FARTHEST of the parts from --camera, metres")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="processes; all cores of this process if left out")
    ] = None,
    seed: Annotated[int, typer.Option(help="another seed, other images")] = 0,
    preview: Annotated[
        bool, typer.Option("--preview", help="write OUT.preview.png, a contact sheet, and stop")
    ] = False,
    shard: Annotated[
        str, typer.Option(help="i/n: only the i-th of n parts, counted from 0")
    ] = "0/1",
    engine: Annotated[str, typer.Option(help="local or ray")] = "local",
    ray_address: Annotated[
        str | None, typer.Option(help="of a running Ray cluster; a local one if left out")
    ] = None,
    renderer: Annotated[str, typer.Option(help="raster or photoreal")] = "raster",
    backgrounds: Annotated[
        str, typer.Option(help="procedural, skimage, or a folder of photos")
    ] = "procedural",
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", help="change a field of the preset: lighting.num_lights=[1,3]"),
    ] = None,
    negatives: Annotated[
        list[str] | None, typer.Option(help="further parts shown as distractors")
    ] = None,
) -> None:
    """Render labelled images of parts; the same command goes on after any interruption.

    Exit codes: 0 done; 1 stopped (disk full, a worker died); 2 wrong input; 130, 143 interrupted.
    """
    with resumable():
        from dopepp.data.render_job import make_job
        from dopepp.data.render_run import run

        job = make_job(
            parts, unit=unit, preset=preset, changes=changes or (), size=size, seed=seed,
            backgrounds=backgrounds, negatives=negatives or (), renderer=renderer, layout=layout,
            camera=camera, working_distance=working_distance,
        )  # fmt: skip
        if preview:
            from dopepp.data.render_preview import (
                write_preview,  # fonts and drawing take a second
            )

            typer.echo(write_preview(job, out))
        else:
            typer.echo(run(job, out, num, shard, workers, engine, ray_address))


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


def symmetries(
    part: Annotated[
        str, typer.Argument(help="a mesh file (STL, OBJ, PLY, GLB, 3MF, OFF) or a built-in part")
    ],
    unit: Unit = None,
    tolerance: Annotated[
        float, typer.Option(help="largest miss of the surface, share of the diameter")
    ] = 0.01,
) -> None:
    """Find a part's symmetries and print its entry of BOP's models_info.json."""
    from dopepp.data.part_symmetries import describe_symmetries

    with report_errors():
        typer.echo(describe_symmetries(part, unit, tolerance))
