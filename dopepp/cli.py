"""The console command ``dopepp``; each subcommand imports what it needs when it is called."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from dopepp.core.errors import UserError

_STOPPED = 1
_DEFECTS = 1
_USERS_MISTAKE = 2

_UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""Of the click that this version of Typer brings along or imports."""


class _OneLine(TyperGroup):
    """Tells a wrong option or a missing argument in one line, as any other mistake."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except _UsageError as error:
            line = " ".join(error.format_message().split())  # type: ignore[attr-defined]
            typer.echo(f"{line.rstrip('.')}; --help lists what there is", err=True)
            raise typer.Exit(_USERS_MISTAKE) from error


app = typer.Typer(cls=_OneLine, no_args_is_help=True, add_completion=False, help=__doc__)


@app.callback()
def _configure() -> None:
    """Poses of weakly textured parts: render, check, predict and compare."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")


@contextmanager
def report_errors() -> Iterator[None]:
    """End the command with one line for a user's mistake."""
    try:
        yield
    except UserError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(_USERS_MISTAKE) from error


@contextmanager
def _resumable() -> Iterator[None]:
    """End the command with one line when it is interrupted or cannot go on, too."""
    from dopepp.core.interrupts import Interruption, StoppedError, interruptible

    try:
        with report_errors(), interruptible():
            yield
    except StoppedError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(_STOPPED) from error
    except Interruption as interruption:
        typer.echo(str(interruption), err=True)
        raise typer.Exit(interruption.exit_code) from interruption


@app.command()
def predict(
    checkpoint: Annotated[Path, typer.Argument(help="best.ckpt of a run")],
    image: Annotated[Path, typer.Argument(help="a picture (PNG, JPEG)")],
    intrinsics: Annotated[
        tuple[float, float, float, float], typer.Option("--K", help="fx fy cx cy, pixels")
    ],
    overlay: Annotated[Path | None, typer.Option(help="write the picture with wireframes")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, …")] = "cpu",
    verify: Annotated[
        bool, typer.Option("--verify", help="add how well picture and drawn part agree, 0 to 1")
    ] = False,
    parts: Annotated[
        list[str] | None,
        typer.Option("--part", help="for --verify: built-in part, mesh file, or NAME=FILE"),
    ] = None,
    unit: Annotated[str | None, typer.Option(help="of the mesh files: mm, cm, m, inch")] = None,
    refine: Annotated[str | None, typer.Option(help="depth: refine with --depth")] = None,
    depth: Annotated[
        Path | None, typer.Option(help="16-bit PNG aligned to the picture, 0 where unknown")
    ] = None,
    depth_scale: Annotated[float, typer.Option(help="metres per unit of --depth")] = 0.001,
) -> None:
    """Print the poses on one picture as JSON, a line per detection; why, where there is none."""
    from dopepp.core.files import write_png
    from dopepp.drawing.overlay import YELLOW, Wireframe
    from dopepp.drawing.overlay import overlay as draw
    from dopepp.drawing.pictures import read_rgb
    from dopepp.geometry.camera import camera_matrix
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.refinement.view import read_depth
    from dopepp.virtual.agreement import agreement, meshes_of

    with report_errors():
        picture, K = read_rgb(image), camera_matrix(*intrinsics)
        if (refine is None) != (depth is None):
            raise UserError(
                "--depth without --refine" if refine is None else "--refine without --depth",
                "both or none of them",
                "add --refine depth" if refine is None else "add --depth FILE",
            )
        estimator = PoseEstimator.load(checkpoint, device, refine)
        metres = None if depth is None else read_depth(depth, depth_scale)
        found = estimator.predict(picture, K, depth=metres)
        agreements: list[float] = []
        if verify:
            meshes = meshes_of(estimator.parts, parts or (), unit)
            agreements = [agreement(picture, K, one.T_cam_obj, meshes[one.object]) for one in found]
    if not found:
        typer.echo("nothing found: " + "; ".join(estimator.explain(picture, K)), err=True)
    for number, one in enumerate(found):
        record = {
            "object": one.object,
            "score": one.score,
            "T_cam_obj": one.T_cam_obj.tolist(),
            "keypoints": one.keypoints.tolist(),
            "reprojection_error_px": one.reprojection_error_px,
        }
        if verify:
            record["agreement"] = agreements[number]
        typer.echo(json.dumps(record))
    if overlay is not None:
        wireframes = [Wireframe(one.keypoints, YELLOW, one.object) for one in found]
        write_png(overlay, draw(picture, wireframes))


@app.command()
def render(
    parts: Annotated[
        list[str],
        typer.Argument(
            help="mesh files (STL, OBJ, PLY, GLB, 3MF, OFF), built-in parts, or NAME=FILE"
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder of the data set; with --preview also a .png")],
    num: Annotated[int | None, typer.Option("-n", help="number of images")] = None,
    unit: Annotated[str | None, typer.Option(help="of the mesh files: mm, cm, m, inch")] = None,
    layout: Annotated[str, typer.Option("--format", help="bop, ndds or webdataset")] = "bop",
    preset: Annotated[str, typer.Option(help="paper, bin, table, quickstart or ycb")] = "paper",
    size: Annotated[
        str | None, typer.Option(help="WIDTHxHEIGHT (or W,H), pixels; the preset's if left out")
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
    with _resumable():
        from dopepp.data.jobs.job import make_job
        from dopepp.data.jobs.render_dataset import RenderRequest, run, write_preview

        job = make_job(
            parts, unit=unit, preset=preset, changes=changes or (), size=size, seed=seed,
            backgrounds=backgrounds, negatives=negatives or (), renderer=renderer, layout=layout,
        )  # fmt: skip
        if preview:
            typer.echo(write_preview(job, out))
        else:
            order = RenderRequest(out, num, shard, workers, engine, ray_address)
            typer.echo(run(job, order))


@app.command()
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
        raise typer.Exit(_DEFECTS)


@app.command()
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
    with _resumable(), Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=None)
        photos = fetch_and_unpack(
            name, out, lambda there, total: bar.update(task, completed=there, total=total)
        )
    typer.echo(photos)


@app.command()
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
    from dopepp.experiment.reports.compare import compare_paths

    with report_errors():
        typer.echo(compare_paths(runs, out, baseline, pictures, table))


@app.command()
def symmetries(
    part: Annotated[
        str, typer.Argument(help="a mesh file (STL, OBJ, PLY, GLB, 3MF, OFF) or a built-in part")
    ],
    unit: Annotated[str | None, typer.Option(help="of the mesh file: mm, cm, m, inch")] = None,
    tolerance: Annotated[
        float, typer.Option(help="largest miss of the surface, share of the diameter")
    ] = 0.01,
) -> None:
    """Find a part's symmetries and print its entry of BOP's models_info.json."""
    from dopepp.data.part_symmetries import describe_symmetries

    with report_errors():
        typer.echo(describe_symmetries(part, unit, tolerance))


@app.command()
def release(
    checkpoint: Annotated[Path, typer.Argument(help="best.ckpt of a run, or its tuned copy")],
    name: Annotated[str, typer.Argument(help="what it is called: pretrained/NAME")],
    results: Annotated[
        Path, typer.Option(help="metrics.json of the run, or of an evaluation of this checkpoint")
    ],
    out: Annotated[Path, typer.Option(help="folder of both files")] = Path(),
) -> None:
    """Write a checkpoint as NAME.safetensors, small and without local paths, and a model card."""
    from dopepp.experiment.runs.release import release as write

    with report_errors():
        for path in write(checkpoint, results, name, out):
            typer.echo(f"{path}, {path.stat().st_size:,} bytes")
