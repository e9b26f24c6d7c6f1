"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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

Meshes = Annotated[
    list[str] | None,
    typer.Option(
        "--part", help="mesh in place of the checkpoint's: built-in part, file, or NAME=FILE"
    ),
]

Unit = Annotated[str | None, typer.Option(help="of the mesh files: mm, cm, m, inch")]

Device = Annotated[str, typer.Option(help="cpu, cuda, …")]
