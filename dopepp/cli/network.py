"""A network on this machine: ``dopepp doctor``, ``benchmark`` and ``serve``."""

from __future__ import annotations

import logging
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Final

import typer

from dopepp.cli.errors import report_errors
from dopepp.cli.options import (
    CameraFile,
    Crop,
    Device,
    Distances,
    Intrinsics,
    KSize,
    Meshes,
    Region,
    Unit,
    check_region,
)
from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from dopepp.drawing.pictures import Picture
    from dopepp.geometry.camera import CameraMatrix
    from dopepp.inference.benchmark import Timing
    from dopepp.inference.estimator import PoseEstimator

NUM_SCENES: Final = 10
SIZE: Final = (640, 480)
"""Rendered pictures, in turn, and their width and height."""


def benchmark(
    models: Annotated[list[Path], typer.Argument(help="checkpoints and exported files")],
    image: Annotated[Path | None, typer.Option(help="a picture; else 640×480 renders")] = None,
    intrinsics: Intrinsics = None,
    refine: Region = None,
    frames: Annotated[int, typer.Option("-n", min=1, max=100_000, help="frames to time")] = 50,
    device: Device = "cpu",
) -> None:
    """Print what a frame takes, from picture to poses, with the parts of it, in milliseconds."""
    with report_errors():
        from dopepp.inference.benchmark import time_frames
        from dopepp.inference.estimator import PoseEstimator
        from dopepp.inference.runtimes import num_threads
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


def doctor(
    image: Annotated[Path, typer.Argument(help="a picture (PNG, JPEG, TIFF)")],
    model: Annotated[Path, typer.Option(help="best.ckpt of a run, or a released network")],
    intrinsics: Intrinsics = None,
    camera: CameraFile = None,
    K_size: KSize = None,
    crop: Crop = None,
    distance: Distances = None,
    refine: Region = None,
    parts: Meshes = None,
    unit: Unit = None,
    device: Device = "cpu",
) -> None:
    """Say what is wrong with a picture, its camera or its part, and what to do, a line each.

    Findings come first, in the order of causes, then what is well. Exit codes: 0 nothing is wrong;
    1 something is; 2 wrong input.
    """
    from dopepp.drawing.pictures import read_photo
    from dopepp.geometry.camera import camera_matrix
    from dopepp.inference.frames.media import Images
    from dopepp.inference.frames.source import Lens, choose_camera

    with report_errors():
        check_region(refine)
        K = None if intrinsics is None else camera_matrix(*intrinsics)
        lens = Lens(choose_camera(K, camera, Images([image])), K_size, crop)
        picture = read_photo(image)
        from dopepp.inference.diagnosis import Case, Diagnosis, diagnose
        from dopepp.inference.estimator import PoseEstimator
        from dopepp.parts.catalogue import with_meshes

        estimator = PoseEstimator.load(model, device)
        known = with_meshes(estimator.parts, parts, unit) if parts else estimator.parts
        estimator = estimator if refine is None else estimator.refining(refine, known)
        try:
            case = Case(estimator, *lens.undistort(picture), known, distance, crop is not None)
        except UserError as error:
            got = f"{error.got}; allowed: {error.allowed}"
            findings = [Diagnosis("camera", got, error.fix)]
        else:
            findings = diagnose(case)
    wrong = [one for one in findings if one.fix]
    for one in (*wrong, *(one for one in findings if not one.fix)):
        typer.echo(f"{'!!' if one.fix else 'ok'} {one}")
    if wrong:
        raise typer.Exit(1)


def serve(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="MODEL", help="best.ckpt of a run, or pretrained/NAME")
    ],
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="else the first free one from 7860")
    ] = None,
    refine: Region = None,
    device: Device = "cpu",
) -> None:
    """Show a page for this machine's browser: drop a picture, see its poses, download them.

    Nobody else reaches it, and it loads nothing from elsewhere.
    """
    from dopepp.core.errors import Interruption, interruptible, require

    # Gradio asks its own server for signs of life.
    logging.getLogger("httpx").setLevel(logging.WARNING)
    with report_errors():
        require("gradio", "dopepp serve", "web")
        check_region(refine)
        from dopepp.inference.estimator import PoseEstimator
        from dopepp.inference.page import served

        estimator = PoseEstimator.load(checkpoint, device, refine)
        with suppress(Interruption), interruptible(""), served(estimator, port) as address:
            typer.echo(f"{address} (Ctrl-C ends it)")
            Event().wait()
