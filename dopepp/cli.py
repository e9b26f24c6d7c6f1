"""The console command ``dopepp``; each subcommand imports what it needs when it is called."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Annotated

import typer

from dopepp.errors import UserError

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)

_USERS_MISTAKE = 2


@app.callback()
def _configure() -> None:
    """Poses of weakly textured parts: predict and compare."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")


@app.command()
def predict(
    checkpoint: Annotated[Path, typer.Argument(help="best.ckpt of a run")],
    image: Annotated[Path, typer.Argument(help="a picture (PNG, JPEG)")],
    intrinsics: Annotated[
        tuple[float, float, float, float], typer.Option("--K", help="fx fy cx cy, pixels")
    ],
    overlay: Annotated[Path | None, typer.Option(help="write the picture with wireframes")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, …")] = "cpu",
) -> None:
    """Print the poses on one picture as JSON, a line per detection."""
    from dopepp.data.images import read_rgb
    from dopepp.drawing.overlay import YELLOW, Wireframe
    from dopepp.drawing.overlay import overlay as draw
    from dopepp.drawing.png import write_png
    from dopepp.geometry.camera import camera_matrix
    from dopepp.inference.estimator import PoseEstimator

    try:
        picture = read_rgb(image)
        found = PoseEstimator.load(checkpoint, device).predict(picture, camera_matrix(*intrinsics))
    except UserError as error:
        _fail(error)
    for one in found:
        record = {
            "object": one.object,
            "score": one.score,
            "T_cam_obj": one.T_cam_obj.tolist(),
            "keypoints": one.keypoints.tolist(),
            "reprojection_error_px": one.reprojection_error_px,
        }
        typer.echo(json.dumps(record))
    if overlay is not None:
        wireframes = [Wireframe(one.keypoints, YELLOW, one.object) for one in found]
        write_png(overlay, draw(picture, wireframes))


@app.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(help="run folders; a model `dope` comes first")],
    out: Annotated[Path, typer.Option(help="folder for table and figure")] = Path("compare"),
) -> None:
    """Put finished runs into one table (CSV, Markdown) and one figure."""
    from dopepp.experiment.compare import compare as compare_results
    from dopepp.experiment.sweep import read_job

    try:
        results = [read_job(run) for run in runs]
        names = [result.name for result in results]
        for run, result in zip(runs, results, strict=True):
            if names.count(result.name) > 1:
                result.name = f"{result.name} {run.name}"
        compare_results(results, out)
    except UserError as error:
        _fail(error)


def _fail(error: UserError) -> None:
    typer.echo(str(error), err=True)
    raise typer.Exit(_USERS_MISTAKE)
