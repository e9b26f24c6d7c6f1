"""A mesh as the binary PLY file that BOP data sets hold: millimetres, normals, texture."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from dopepp.data.bop_truth import MM
from dopepp.parts.part import Mesh


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
