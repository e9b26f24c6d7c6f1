"""Options that several commands have, and their checks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dopepp.core.errors import UserError

Intrinsics = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option("--K", help="fx fy cx cy, pixels; or --camera, or what a bag says"),
]

CameraFile = Annotated[
    Path | None,
    typer.Option(help="camera file: ROS, OpenCV, BOP, COLMAP, or text with 3×3 numbers"),
]

KSize = Annotated[
    tuple[int, int] | None,
    typer.Option("--K-size", help="width height that K is of, if the picture was resized"),
]

Crop = Annotated[
    tuple[int, int, int, int] | None,
    typer.Option(help="x y width height, if the picture was cut out of the calibrated one"),
]

Distances = Annotated[
    tuple[float, float] | None,
    typer.Option("--distance", help="nearest and farthest part, metres; else those of training"),
]

Region = Annotated[
    str | None, typer.Option("--refine", help="region: poses refined on the picture")
]

MaxMs = Annotated[float | None, typer.Option(help="of refining, then poses stay the network's")]

Track = Annotated[bool, typer.Option("--track", help="follow the parts from picture to picture")]

Meshes = Annotated[
    list[str] | None,
    typer.Option(
        "--part", help="mesh in place of the checkpoint's: built-in part, file, or NAME=FILE"
    ),
]

Unit = Annotated[str | None, typer.Option(help="of the mesh files: mm, cm, m, inch")]

Device = Annotated[str, typer.Option(help="cpu, cuda, …")]


def check_region(refine: str | None) -> None:
    """Refuse another refinement than ``region``."""
    if refine not in (None, "region"):
        raise UserError(f"--refine {refine}", "region, or none", "leave it out")
