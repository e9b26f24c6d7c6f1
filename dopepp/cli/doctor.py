"""``dopepp doctor``: why poses on a picture are missing or bad."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dopepp.cli.errors import report_errors
from dopepp.cli.options import CameraFile, Crop, Device, KSize, Meshes, Unit


def doctor(
    image: Annotated[Path, typer.Argument(help="a picture (PNG, JPEG, TIFF)")],
    model: Annotated[Path, typer.Option(help="best.ckpt of a run, or a released network")],
    intrinsics: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option("--K", help="fx fy cx cy, pixels; or --camera"),
    ] = None,
    camera: CameraFile = None,
    K_size: KSize = None,
    crop: Crop = None,
    distance: Annotated[
        tuple[float, float] | None,
        typer.Option(help="nearest and farthest part, metres; else those of training"),
    ] = None,
    refine: Annotated[
        str | None, typer.Option(help="region: judge the poses that --refine region makes")
    ] = None,
    parts: Meshes = None,
    unit: Unit = None,
    device: Device = "cpu",
) -> None:
    """Say what is wrong with a picture, its camera or its part, and what to do, a line each.

    Findings come first, in the order of causes, then what is well. Exit codes: 0 nothing is wrong;
    1 something is; 2 wrong input.
    """
    from dopepp.core.errors import UserError
    from dopepp.drawing.pictures import read_photo
    from dopepp.geometry.camera import camera_matrix
    from dopepp.inference.sources.files import Pictures
    from dopepp.inference.sources.source import Lens, one_camera

    with report_errors():
        if refine not in (None, "region"):
            raise UserError(f"--refine {refine}", "region, or none", "leave it out")
        K = None if intrinsics is None else camera_matrix(*intrinsics)
        lens = Lens(one_camera(K, camera, Pictures([image])), K_size, crop)
        picture = read_photo(image)
        from dopepp.inference.diagnosis import Case, Finding, diagnose
        from dopepp.inference.estimator import PoseEstimator
        from dopepp.parts.catalogue import with_meshes

        estimator = PoseEstimator.load(model, device)
        known = with_meshes(estimator.parts, parts, unit) if parts else estimator.parts
        estimator = estimator if refine is None else estimator.refining(refine, known)
        try:
            case = Case(estimator, *lens.seen(picture), known, distance, crop is not None)
        except UserError as error:
            got = f"{error.got}; allowed: {error.allowed}"
            findings = [Finding("camera", got, error.fix)]
        else:
            findings = diagnose(case)
    wrong = [one for one in findings if one.fix]
    for one in (*wrong, *(one for one in findings if not one.fix)):
        typer.echo(f"{'!!' if one.fix else 'ok'} {one}")
    if wrong:
        raise typer.Exit(1)
