"""``dopepp render``: a data set of labelled images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from dopepp.cli.errors import resumable
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
        from dopepp.data.jobs.job import make_job
        from dopepp.data.jobs.rendering import run

        job = make_job(
            parts, unit=unit, preset=preset, changes=changes or (), size=size, seed=seed,
            backgrounds=backgrounds, negatives=negatives or (), renderer=renderer, layout=layout,
            camera=camera, working_distance=working_distance,
        )  # fmt: skip
        if preview:
            from dopepp.data.jobs.preview import write_preview  # fonts and drawing take a second

            typer.echo(write_preview(job, out))
        else:
            typer.echo(run(job, out, num, shard, workers, engine, ray_address))
