"""BOP's object models, written: ``obj_000001.ply`` and ``models_info.json``, millimetres."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.data.formats.bop.images import encode_png
from dopepp.data.formats.bop.models import INFO_FILE, MODEL_FOLDERS
from dopepp.data.formats.bop.records import MM, model_numbers
from dopepp.parts.part import Mesh, Part


def write_models(root: Path, parts: Sequence[Part]) -> None:
    """Write the parts' models, and ``models_info.json`` last, as a sign.

    They are numbered as :func:`~dopepp.data.formats.bop.records.model_numbers` says. A UserError: a
    part has no mesh, or the folder holds models of other parts.
    """
    meshes, numbers = [], model_numbers([part.name for part in parts])
    for part in parts:
        if part.mesh is None:
            raise UserError(
                f"part {part.name} without a mesh", "parts that were read from a mesh file",
                "give the part's mesh file",
            )  # fmt: skip
        meshes.append(part.mesh)
    folder = root / MODEL_FOLDERS[0]
    entries = {str(numbers[part.name]): model_info(part) for part in parts}
    content = (json.dumps(entries, indent=2, ensure_ascii=False) + "\n").encode()
    path = folder / INFO_FILE
    if path.exists():
        if path.read_bytes() != content:
            raise UserError(
                f"{path}, written for other parts", f"a folder for {[p.name for p in parts]}",
                "choose an empty folder",
            )  # fmt: skip
        return
    for number, mesh in zip(numbers.values(), meshes, strict=True):
        model, texture = folder / f"obj_{number:06d}.ply", folder / f"obj_{number:06d}.png"
        write_whole(model, ply_bytes(mesh, None if mesh.texture is None else texture.name))
        if mesh.texture is not None:
            write_whole(texture, encode_png(mesh.texture))
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


def ply_bytes(mesh: Mesh, texture_name: str | None = None) -> bytes:
    """Return a mesh as binary PLY.

    Its texture, named ``texture_name``, is written beside it.
    """
    textured = texture_name is not None and mesh.uv is not None
    names = ["x", "y", "z", "nx", "ny", "nz"]
    import trimesh  # takes a while: only for those who write models

    # Weighted by the angles of the faces around a vertex, as BOP's are (Thürmer, Wüthrich 1998).
    normals = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals
    columns = [mesh.vertices * MM, np.asarray(normals)]
    if textured:
        names += ["texture_u", "texture_v"]
        columns.append(np.asarray(mesh.uv))
    shade = 0 if mesh.colours is None else 3
    values = np.hstack(columns).astype("<f4")
    vertices = np.empty(len(values), [("numbers", "<f4", values.shape[1]), ("colour", "u1", shade)])
    vertices["numbers"] = values
    if mesh.colours is not None:
        vertices["colour"] = mesh.colours
    faces: NDArray[Any] = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment TextureFile {texture_name}"] if textured else []),
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in names),
        *(f"property uchar {name}" for name in ("red", "green", "blue")[:shade]),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()
