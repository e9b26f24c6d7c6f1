"""The parts as BOP's ``models/``: a PLY file and a texture each, and ``models_info.json``.

A mesh as the binary PLY file that BOP data sets hold: millimetres, normals, texture.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.data.formats.bop.images import encode_png
from dopepp.data.formats.bop.models import INFO_FILE, MODEL_FOLDERS
from dopepp.data.formats.bop.records import MM
from dopepp.parts.part import Mesh, Part


def ply_bytes(mesh: Mesh, texture_name: str | None = None) -> bytes:
    """Return a mesh as binary PLY.

    Args:
        mesh: Metres.
        texture_name: File name of its texture, written beside the PLY; None without one.
    """
    textured = texture_name is not None and mesh.uv is not None
    names = ["x", "y", "z", "nx", "ny", "nz"]
    columns = [mesh.vertices * MM, vertex_normals(mesh.vertices, mesh.faces)]
    if textured:
        names += ["texture_u", "texture_v"]
        columns.append(np.asarray(mesh.uv))
    vertices = np.hstack(columns).astype("<f4")
    faces: NDArray[Any] = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment TextureFile {texture_name}"] if textured else []),
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def vertex_normals(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Return unit normals, weighted by the angles of the faces around a vertex as BOP's are.

    Source: Thürmer and Wüthrich, "Computing vertex normals from polygonal facets", 1998.
    """
    corners = vertices[faces]
    edges = corners[:, [1, 2, 0]] - corners
    across = np.cross(edges[:, 0], edges[:, 1])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    unit = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), np.finfo(float).tiny)
    angles = np.arccos(np.clip(-(unit * unit[:, [2, 0, 1]]).sum(axis=2), -1, 1))
    normals = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(normals, faces[:, corner], angles[:, corner, None] * across)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.maximum(lengths, 1e-12))


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
