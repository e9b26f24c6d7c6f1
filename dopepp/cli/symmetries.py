"""``dopepp symmetries``: those of a part."""

from __future__ import annotations

from typing import Annotated

import typer

from dopepp.cli.errors import report_errors


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
