"""``dopepp benchmark``: what a frame takes on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from dopepp.cli.errors import report_errors
from dopepp.cli.options import Device
from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from dopepp.drawing.pictures import Picture
    from dopepp.geometry.camera import CameraMatrix
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.timing import Timing

NUM_SCENES: Final = 10
SIZE: Final = (640, 480)
"""Rendered pictures, in turn, and their width and height."""


def benchmark(
    models: Annotated[list[Path], typer.Argument(help="checkpoints and exported files")],
    image: Annotated[
        Path | None, typer.Option(help="a picture; rendered scenes of 640×480 if left out")
    ] = None,
    intrinsics: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option("--K", help="fx fy cx cy of the picture, pixels"),
    ] = None,
    refine: Annotated[str | None, typer.Option(help="region: on the picture")] = None,
    frames: Annotated[int, typer.Option("-n", min=1, max=100_000, help="frames to time")] = 50,
    device: Device = "cpu",
) -> None:
    """Print what a frame takes, from picture to poses, with the parts of it, in milliseconds."""
    with report_errors():
        from dopepp.inference.estimator import PoseEstimator
        from dopepp.inference.runtimes.runtime import num_threads
        from dopepp.inference.timing import time_frames
        from dopepp.parts.catalogue import with_meshes

        if (image is None) != (intrinsics is None):
            fix = "give --image FILE --K FX FY CX CY, or none of them"
            raise UserError("one of --image and --K", "both or none of them", fix)
        rows = []
        for path in models:
            estimator = PoseEstimator.load(path, device)
            pictures = _pictures(estimator, path, image, intrinsics)
            if refine is not None:
                estimator = estimator.refining(refine, with_meshes(estimator.parts))
            rows.append(_row(path, time_frames(estimator, pictures, frames)))
        height, width, _ = pictures[-1][0].shape
        typer.echo(f"{width}×{height} pixels, {frames} frames, {num_threads()} threads; ms")
        _print_table(rows)


def _pictures(
    estimator: PoseEstimator,
    path: Path,
    image: Path | None,
    intrinsics: tuple[float, float, float, float] | None,
) -> list[tuple[Picture, CameraMatrix]]:
    """Return the pictures to look at, with their camera matrices."""
    from dopepp.drawing.pictures import read_photo
    from dopepp.experiment.assembly.renders import validation_renders
    from dopepp.geometry.camera import camera_matrix

    if image is not None and intrinsics is not None:
        return [(read_photo(image), camera_matrix(*intrinsics))]
    source = validation_renders(estimator.checkpoint, path, NUM_SCENES, SIZE)
    samples = [source.sample(index) for index in range(NUM_SCENES)]
    return [(one.image, one.K) for one in samples]


def _row(path: Path, timing: Timing) -> dict[str, str]:
    """Return a line of the table: medians, and of whole frames the 95th percentile as well."""
    import numpy as np

    p50, p95 = np.percentile(timing.frame, (50, 95))
    return {
        "model": str(path),
        "p50": f"{p50:.1f}",
        "p95": f"{p95:.1f}",
        "first": f"{timing.first:.0f}",
        **{step: f"{np.median(spent):.1f}" for step, spent in timing.steps.items()},
        "frames/s": f"{1000 / p50:.1f}",
        "found": f"{timing.num_found:.1f}",
    }


def _print_table(rows: list[dict[str, str]]) -> None:
    widths = {key: max(len(key), *(len(row[key]) for row in rows)) for key in rows[0]}
    for row in ({key: key for key in rows[0]}, *rows):
        cells = [row[key].rjust(width) for key, width in list(widths.items())[1:]]
        typer.echo("  ".join([row["model"].ljust(widths["model"]), *cells]))
