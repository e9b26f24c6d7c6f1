"""What a simulator takes for a solid: convex pieces, by CoACD (Wei et al. 2022), cut once a mesh.

Cutting takes a minute, so pieces are kept: those of the built-in parts in the package, those of
other meshes in the user's cache, under the hash of the mesh.
"""

from __future__ import annotations

import io
import logging
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.files import cache_folder, write_whole
from dopepp.parts.part import Mesh, Part

Piece = Float[np.ndarray, "vertices 3"]

CONCAVITY: Final = 0.05
"""Of CoACD: how far a piece may be from its convex hull, as a share of the whole."""

MAX_PIECES: Final = 64

_KEPT: Final = Path(__file__).parent / "data"

_log = logging.getLogger(__name__)


def convex_pieces(part: Part) -> tuple[Piece, ...]:
    """Return convex pieces that together have a part's shape, its frame, metres.

    A :class:`UserError`: the part has no mesh.
    """
    if part.mesh is None:
        raise UserError(
            f"part {part.name} without a mesh", "a built-in part or a mesh file", "pass --part FILE"
        )
    name = f"{part.mesh_hash[:16]}.npz"
    for place in (_KEPT / name, cache_folder() / "solids" / name):
        if place.is_file():
            return _read(place)
    _log.info("%s: its mesh is cut into convex pieces, once; this takes a minute", part.name)
    pieces = _cut(part.mesh)
    write_whole(cache_folder() / "solids" / name, _packed(pieces))
    return pieces


def _cut(mesh: Mesh) -> tuple[Piece, ...]:
    import coacd

    coacd.set_log_level("error")
    # A watertight mesh is cut as it is: to make a manifold of it rounds its edges.
    found: list[Any] = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces), threshold=CONCAVITY, max_convex_hull=MAX_PIECES,
        preprocess_mode="auto", resolution=500, mcts_nodes=10, mcts_iterations=30,
        mcts_max_depth=2, seed=0,
    )  # fmt: skip
    return tuple(np.asarray(vertices, np.float64) for vertices, _ in found)


def _packed(pieces: tuple[Piece, ...]) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(
        content,
        vertices=np.concatenate(pieces).astype(np.float32),
        counts=[len(piece) for piece in pieces],
    )
    return content.getvalue()


def _read(path: Path) -> tuple[Piece, ...]:
    try:
        with np.load(path, allow_pickle=False) as content:
            vertices, counts = np.asarray(content["vertices"], np.float64), content["counts"]
        return tuple(np.split(vertices, np.cumsum(counts)[:-1]))
    except (OSError, KeyError, ValueError) as error:
        raise UserError(
            f"{path}: {error}", "a file that dopepp has written", "delete it"
        ) from error
