"""Options that several commands share, and how a command reports errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from dopepp.core.errors import RESUME, Interruption, RunError, UserError, interruptible

Model = Annotated[Path, Argument(help="Checkpoint (best.ckpt of a run) or released network.")]

Intrinsics = Annotated[
    tuple[float, float, float, float] | None,
    Option("--K", help="fx fy cx cy in pixels (instead of --camera)."),
]

CameraFile = Annotated[
    Path | None, Option(help="Camera file: ROS, OpenCV, BOP, COLMAP, or text with a 3×3 matrix.")
]

KSize = Annotated[
    tuple[int, int] | None,
    Option("--K-size", help="Size of the calibrated image, if it was resized."),
]

Crop = Annotated[
    tuple[int, int, int, int] | None,
    Option(help="x y width height, if the calibrated image was cropped."),
]

Distances = Annotated[
    tuple[float, float] | None,
    Option("--distance", help="Range of the parts, metres (default: that of the training)."),
]

Region = Annotated[str | None, Option("--refine", help="region: refine the poses on the picture.")]

Conf = Annotated[
    float | None,
    Option(help="Minimum score of a pose, 0 to 1 (default: the checkpoint's threshold)."),
]

MaxMs = Annotated[
    float | None, Option(help="Time limit of the refinement per picture, milliseconds.")
]

ScaleError = Annotated[
    float | None,
    Option(help="Largest relative error of part size or focal length (default: 0.01)."),
]

Track = Annotated[bool, Option("--track", help="Track the parts from frame to frame.")]

Meshes = Annotated[
    list[str] | None, Option("--part", help="Replacement mesh: built-in part, file, or NAME=FILE.")
]

Unit = Annotated[str | None, Option(help="Unit of the mesh files: mm, cm, m or inch.")]

Device = Annotated[str, Option(help="PyTorch device, e.g. cpu or cuda.")]


def check_region(refine: str | None) -> None:
    """Refuse any refinement other than ``region``."""
    if refine not in (None, "region"):
        raise UserError(f"--refine {refine}", "region", "pass --refine region, or leave it out")


@contextmanager
def report_errors() -> Iterator[None]:
    """Print an expected error as one line and exit with its code."""
    try:
        yield
    except (UserError, RunError, Interruption) as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(error.exit_code) from error


@contextmanager
def resumable(advice: str = RESUME) -> Iterator[None]:
    """Report errors, and exit in order on Ctrl-C or SIGTERM.

    Args:
        advice: What the message of an interruption recommends.
    """
    with report_errors(), interruptible(advice):
        yield
