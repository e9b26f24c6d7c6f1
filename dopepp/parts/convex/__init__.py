"""Convex pieces: the shape of a part for simulations of rigid bodies.

The decomposition (CoACD, Wei et al. 2022; extra ``robot``) takes a minute and is cached: for
built-in parts in this package, for others in the user's cache, by triangles and settings.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from dopepp.core.errors import UserError, require
from dopepp.core.files import cache_folder, write_file
from dopepp.parts.mesh import hash_triangles
from dopepp.parts.part import Mesh, Part

Piece = Float[np.ndarray, "vertices 3"]

CONCAVITY: Final = 0.05  # CoACD's threshold: largest distance of a piece from its convex hull
MAX_PIECES: Final = 64
_SEARCH: Final = {
    "resolution": 500,
    "mcts_nodes": 10,
    "mcts_iterations": 30,
    "mcts_max_depth": 2,
}
_VERSION: Final = 1  # of the decomposition; a change makes all cached pieces anew
_BUILT_IN: Final = Path(__file__).parent

logger = logging.getLogger(__name__)


def convex_pieces(part: Part) -> tuple[Piece, ...]:
    """Return the vertices (object frame, metres) of convex pieces that make up a part's shape.

    Raises:
        UserError: The part has no mesh, the cached pieces are damaged, or the extra ``robot``
            is not installed.
    """
    if part.mesh is None:
        problem, allowed = f"part {part.name} without a mesh", "a built-in part or a mesh file"
        raise UserError(problem, allowed, "pass --part FILE")
    path = _BUILT_IN / f"{part.mesh_hash[:16]}.npz"
    if not path.is_file():
        # A part of a checkpoint has fewer triangles than the mesh of its hash.
        triangles = hash_triangles(part.mesh.vertices, part.mesh.faces)
        settings = json.dumps([_VERSION, triangles, CONCAVITY, MAX_PIECES, _SEARCH])
        name = hashlib.sha256(settings.encode()).hexdigest()[:16]
        path = cache_folder() / "solids" / f"{name}.npz"
    if not path.is_file():
        require("coacd", f"the decomposition of {part.name}", "robot")
        logger.info("%s: decomposing the mesh into convex pieces, once: a minute", part.name)
        pieces, content = _decompose(part.mesh), io.BytesIO()
        vertices = np.concatenate(pieces).astype(np.float32)
        np.savez_compressed(content, vertices=vertices, counts=[len(piece) for piece in pieces])
        write_file(path, content.getvalue())
    return _read_pieces(path)


def hull_faces(hull: ConvexHull) -> Int[np.ndarray, "faces 3"]:
    """Return the triangles of a convex hull as point indices, counter-clockwise from outside."""
    a, b, c = hull.points[hull.simplices].swapaxes(0, 1)
    is_inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces = hull.simplices.astype(np.int32)
    faces[is_inward] = faces[is_inward][:, ::-1]
    return faces


def _decompose(mesh: Mesh) -> tuple[Piece, ...]:
    """Decompose a mesh into at most ``MAX_PIECES`` approximately convex pieces with CoACD."""
    import coacd

    coacd.set_log_level("error")
    pieces: list[Any] = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=CONCAVITY,
        max_convex_hull=MAX_PIECES,
        preprocess_mode="auto",  # only for open meshes: it rounds edges
        seed=0,
        **_SEARCH,
    )
    return tuple(np.asarray(vertices, np.float64) for vertices, _ in pieces)


def _read_pieces(path: Path) -> tuple[Piece, ...]:
    try:
        with np.load(path, allow_pickle=False) as content:
            vertices, counts = np.asarray(content["vertices"], np.float64), content["counts"]
        return tuple(np.split(vertices, np.cumsum(counts)[:-1]))
    except (OSError, KeyError, ValueError, EOFError, BadZipFile) as error:
        fix = "delete this file; the next run creates the file again"
        raise UserError(f"{path}: {error}", "a file written by dopepp", fix) from error
