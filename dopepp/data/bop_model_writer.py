"""The parts as BOP's ``models/``: a PLY file and a texture each, and ``models_info.json``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dopepp.data.bop_images import encode_png
from dopepp.data.bop_models import INFO_FILE, MODEL_FOLDERS
from dopepp.data.bop_ply import ply_bytes
from dopepp.data.bop_truth import MM
from dopepp.drawing.png import write_whole
from dopepp.errors import UserError
from dopepp.parts.part import Part


def write_models(root: Path, parts: Sequence[Part]) -> None:
    """Write the parts as objects 1, 2, …; ``models_info.json`` last, as the sign that all is there.

    Raises:
        UserError: A part has no mesh, or the folder holds models of other parts.
    """
    meshes = [part.mesh for part in parts]
    for part in parts:
        if part.mesh is None:
            raise UserError(
                f"part {part.name} without a mesh", "parts that were read from a mesh file",
                "give the part's mesh file",
            )  # fmt: skip
    folder = root / MODEL_FOLDERS[0]
    entries = {str(number): model_info(part) for number, part in enumerate(parts, start=1)}
    content = (json.dumps(entries, indent=2, ensure_ascii=False) + "\n").encode()
    path = folder / INFO_FILE
    if path.exists():
        if path.read_bytes() != content:
            raise UserError(
                f"{path}, written for other parts", f"a folder for {[p.name for p in parts]}",
                "choose an empty folder",
            )  # fmt: skip
        return
    for number, mesh in enumerate(meshes, start=1):
        assert mesh is not None
        texture = f"obj_{number:06d}.png" if mesh.texture is not None else None
        write_whole(folder / f"obj_{number:06d}.ply", ply_bytes(mesh, texture))
        if texture is not None and mesh.texture is not None:
            write_whole(folder / texture, encode_png(mesh.texture))
    write_whole(path, content)


def model_info(part: Part) -> dict[str, object]:
    """Return a part's entry in ``models_info.json``: millimetres, transforms row by row."""
    lower = part.cuboid[:8].min(axis=0) * MM
    size = part.cuboid[:8].max(axis=0) * MM - lower
    record: dict[str, object] = {"name": part.name, "diameter": part.diameter * MM}
    for axis, first, extent in zip("xyz", lower.tolist(), size.tolist(), strict=True):
        record |= {f"min_{axis}": first, f"size_{axis}": extent}
    if part.symmetries_discrete is not None and len(part.symmetries_discrete):
        scaled = part.symmetries_discrete * np.array([1, 1, 1, MM])[None, None]
        scaled[:, 3, 3] = 1
        record["symmetries_discrete"] = scaled.reshape(-1, 16).tolist()
    if part.symmetries_continuous:
        record["symmetries_continuous"] = [
            {"axis": list(axis), "offset": [value * MM for value in offset]}
            for axis, offset in part.symmetries_continuous
        ]
    return record
