"""Network commands: ``dopepp doctor``, ``benchmark`` and ``serve``."""

from __future__ import annotations

import logging
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer import Argument, Option

from dopepp.cli import options
from dopepp.core.errors import Interruption, UserError, interruptible, require

if TYPE_CHECKING:
    from dopepp.inference.benchmark import Timing

NUM_SCENES: Final = 10  # number of rendered images of a benchmark, used in turn
SIZE: Final = (640, 480)  # width and height of rendered images


def benchmark(
    models: Annotated[list[Path], Argument(help="Checkpoints, exported files and meshes.")],
    image: Annotated[Path | None, Option(help="Image (default: renders).")] = None,
    intrinsics: options.Intrinsics = None,
    refine: options.RefineRegion = None,
    frames: Annotated[int, Option("-n", min=1, max=100_000, help="Number of frames.")] = 50,
    unit: options.Unit = None,
    working_distance: options.WorkingDistance = None,
    tilt: options.Tilt = None,
    device: options.Device = "cpu",
) -> None:
    """Time the steps from an image to its poses, in milliseconds per frame."""
    from dopepp.core.pool import num_threads
    from dopepp.drawing.pictures import read_photo
    from dopepp.experiment.assembly.renders import validation_renders
    from dopepp.geometry.camera import camera_matrix
    from dopepp.inference.benchmark import time_frames
    from dopepp.inference.network_estimator import NetworkEstimator
    from dopepp.parts.catalogue import with_meshes

    options.check_region(refine)
    if (image is None) != (intrinsics is None):
        fix = "pass --image FILE --K FX FY CX CY, or leave out both"
        raise UserError("only one of --image and --K", "both or neither", fix)
    rows, with_mesh = [], any(map(options.is_mesh, models))
    for path in models:
        # With checkpoints and meshes, these options apply to the meshes.
        skips = with_mesh and not options.is_mesh(path)
        of_mesh = (None, None, None) if skips else (unit, working_distance, tilt)
        estimator = options.load_estimator(path, device, *of_mesh)
        if image is not None and intrinsics is not None:
            images = [(read_photo(image), camera_matrix(*intrinsics))]
        elif not isinstance(estimator, NetworkEstimator):
            fix = "pass an image and its camera: --image FILE --K FX FY CX CY"
            raise UserError(f"{path} without --image", "an image, which a mesh requires", fix)
        else:
            source = validation_renders(estimator.checkpoint, path, NUM_SCENES, SIZE)
            samples = map(source.sample, range(NUM_SCENES))
            images = [(sample.image, sample.K) for sample in samples]
        if refine is not None:
            estimator = estimator.refining(refine, with_meshes(estimator.parts))
        rows.append(_row(path, time_frames(estimator, images, frames)))
    height, width, _ = images[-1][0].shape
    typer.echo(f"{width}×{height} pixels, {frames} frames, {num_threads()} threads; ms")
    columns = {key: max(len(key), *(len(row[key]) for row in rows)) for key in rows[0]}
    model_width = columns.pop("model")
    for row in ({key: key for key in rows[0]}, *rows):
        cells = [row[key].rjust(width) for key, width in columns.items()]
        typer.echo("  ".join([row["model"].ljust(model_width), *cells]))


def _row(path: Path, timing: Timing) -> dict[str, str]:
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


def doctor(
    image: Annotated[Path, Argument(help="Image (PNG, JPEG or TIFF).")],
    model: Annotated[Path, Option(help=options.MODEL_HELP)],
    intrinsics: options.Intrinsics = None,
    camera: options.CameraFile = None,
    K_size: options.KSize = None,
    crop: options.Crop = None,
    distance: options.Distances = None,
    refine: options.RefineRegion = None,
    parts: options.Meshes = None,
    unit: options.Unit = None,
    working_distance: options.WorkingDistance = None,
    tilt: options.Tilt = None,
    centres: Annotated[
        list[str] | None,
        Option("--at", help="u,v: pixel of a part's centre; repeat for every part in the image."),
    ] = None,
    empty: Annotated[bool, Option("--empty", help="The image shows none of the parts.")] = False,
    device: options.Device = "cpu",
) -> None:
    """Diagnose an image, its camera and its part, one finding with its remedy per line.

    Problems come first, ordered by cause, then the passed checks. Exit codes: 0 no problem; 1
    problems; 2 wrong input.
    """
    from dopepp.drawing.pictures import read_photo
    from dopepp.geometry.camera import camera_matrix
    from dopepp.inference.frames.media import Images
    from dopepp.inference.frames.source import Lens, choose_camera

    options.check_region(refine)
    if centres and empty:
        fix = "leave out --at or --empty"
        raise UserError("--at together with --empty", "only one of them", fix)
    words = centres or ()
    shown_at = [options.two_numbers("--at", word, "u,v in pixels", "412,230") for word in words]
    K = None if intrinsics is None else camera_matrix(*intrinsics)
    lens = Lens(choose_camera(K, camera, Images([image])), K_size, crop)
    pixels = read_photo(image)
    from dopepp.inference.diagnosis import Case, Diagnosis, diagnose
    from dopepp.parts.catalogue import with_meshes

    try:
        undistorted = lens.undistort(pixels)
    except UserError as error:
        findings = [Diagnosis("camera", f"{error.got}; allowed: {error.allowed}", error.fix)]
    else:
        estimator = options.load_estimator(model, device, unit, working_distance, tilt, parts)
        solid_parts = with_meshes(estimator.parts, parts, unit) if parts else estimator.parts
        estimator = estimator if refine is None else estimator.refining(refine, solid_parts)
        positions = shown_at if centres or empty else None
        case = Case(estimator, *undistorted, solid_parts, distance, crop is not None, positions)
        findings = diagnose(case)
    findings.sort(key=lambda finding: not finding.fix)
    for finding in findings:
        typer.echo(f"{'!!' if finding.fix else 'ok'} {finding}")
    if findings and findings[0].fix:
        raise typer.Exit(1)


def serve(
    model: options.Model,
    port: Annotated[
        int | None, Option(min=1, max=65535, help="Port (default: first free from 7860).")
    ] = None,
    conf: options.Conf = None,
    refine: options.RefineRegion = None,
    unit: options.Unit = None,
    working_distance: options.WorkingDistance = None,
    tilt: options.Tilt = None,
    device: options.Device = "cpu",
) -> None:
    """Open a local web page that estimates poses on uploaded images.

    The page is reachable from this machine only and loads nothing from the network.
    """
    # Gradio polls its own server, which httpx would log.
    logging.getLogger("httpx").setLevel(logging.WARNING)
    require("gradio", "dopepp serve", "web")
    options.check_region(refine)
    from dopepp.inference.page import serve_page

    estimator = options.load_estimator(model, device, unit, working_distance, tilt)
    estimator = estimator if refine is None else estimator.refining(refine)
    estimator = estimator.reporting(conf)
    with suppress(Interruption), interruptible(""), serve_page(estimator, port) as address:
        typer.echo(f"{address} (press Ctrl-C to stop)")
        Event().wait()
