"""How triangles hang together: open edges, and which way the triangles face.

Nothing here moves a vertex. Self-intersecting triangles are not looked for: the depth test of every
renderer shows the outermost surface whether triangles pass through each other or not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dopepp.parts.mesh.measure import Faces, Vertices, face_areas, weld


@dataclass(frozen=True)
class Topology:
    """The edges of triangles, where corners at one position are one.

    Attributes:
        num_open: Edges of one triangle: the rim of a hole.
        neighbours: The two triangles at every other edge.
        opposed: Whether these two run along the edge in the same direction, so that one of them
            shows its inside where the other one shows its outside.
    """

    num_open: int
    num_crowded: int
    neighbours: Int[np.ndarray, "edges 2"]
    opposed: Bool[np.ndarray, " edges"]

    @property
    def is_closed(self) -> bool:
        """Whether every edge has exactly two triangles."""
        return self.num_open == self.num_crowded == 0


def find_topology(vertices: Vertices, faces: Faces) -> Topology:
    """Find the edges of triangles that all have an area."""
    positions, corners = weld(vertices, faces)
    start, end = corners.reshape(-1), corners[:, [1, 2, 0]].reshape(-1)
    # Both directions of an edge get one number; 2³¹ vertices squared still fit into an int64.
    edges = np.minimum(start, end) * len(positions) + np.maximum(start, end)
    order = np.argsort(edges, kind="stable")
    first = np.flatnonzero(np.diff(edges[order], prepend=-1))
    uses = np.diff(first, append=len(edges))
    pairs = first[uses == 2]
    one, other = order[pairs], order[pairs + 1]
    return Topology(
        num_open=int((uses == 1).sum()),
        num_crowded=int((uses > 2).sum()),
        neighbours=np.stack([one // 3, other // 3], axis=1),
        opposed=start[one] == start[other],
    )


def opposed_faces(
    vertices: Vertices, faces: Faces, topology: Topology
) -> Bool[np.ndarray, " faces"]:
    """Find triangles to turn over so that all of a connected surface face the same way.

    In every connected surface those that face one way are kept and the others turned, whichever
    have less area. A surface with one side only, such as a Möbius strip, is left as it is. Where
    the surface is closed and faces inwards as a whole, everything is turned; so is then a single
    body that faces inwards, unless the box of another one holds it, as it does for a cavity.
    """
    turned = np.zeros(len(faces), bool)
    if topology.opposed.any():
        turned = _minority(face_areas(vertices, faces), topology)
    if topology.is_closed:
        if _signed_volumes(vertices, turn_over(faces, turned)).sum() < 0:
            turned = ~turned
        turned ^= _inverted_bodies(vertices, turn_over(faces, turned), topology)
    return turned


def turn_over(faces: Faces, turned: Bool[np.ndarray, " faces"]) -> Faces:
    """Reverse the corners of the marked triangles."""
    return np.where(turned[:, None], faces[:, ::-1], faces)


def _minority(areas: Float[np.ndarray, " faces"], topology: Topology) -> Bool[np.ndarray, " faces"]:
    """Return the triangles that face against most of their connected surface."""
    # Each triangle is two nodes of a graph, as it is and turned over, and an edge joins the nodes
    # that face the same way. A surface with two sides falls into two components: each is one way of
    # facing, and triangle f is to be turned if the component of its turned node is the better one.
    num_faces = len(areas)
    one, other = topology.neighbours.T
    swap = np.where(topology.opposed, num_faces, 0)
    rows = np.concatenate([one, one + num_faces])
    columns = np.concatenate([other + swap, other + num_faces - swap])
    joined = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(2 * num_faces,) * 2)
    as_is, over = connected_components(joined, directed=False)[1].reshape(2, num_faces)
    weight = np.bincount(as_is, areas, minlength=int(max(as_is.max(), over.max())) + 1)
    better = weight[over] > weight[as_is]
    tied = (weight[over] == weight[as_is]) & (over < as_is)
    return np.asarray(better | tied)


def _inverted_bodies(
    vertices: Vertices, faces: Faces, topology: Topology
) -> Bool[np.ndarray, " faces"]:
    """Return the triangles of closed bodies that face inwards and lie in no other body's box."""
    one, other = topology.neighbours.T
    joined = coo_array((np.ones(len(one), bool), (one, other)), shape=(len(faces),) * 2)
    num_bodies, bodies = connected_components(joined, directed=False)
    volumes = np.bincount(bodies, _signed_volumes(vertices, faces), minlength=num_bodies)
    corners = vertices[faces]
    lower, upper = np.full((num_bodies, 3), np.inf), np.full((num_bodies, 3), -np.inf)
    np.minimum.at(lower, bodies, corners.min(axis=1))
    np.maximum.at(upper, bodies, corners.max(axis=1))
    inverted = np.zeros(num_bodies, bool)
    for body in np.flatnonzero(volumes < 0):
        around = (lower < lower[body]).all(axis=1) & (upper > upper[body]).all(axis=1)
        inverted[body] = not around.any()
    return np.asarray(inverted[bodies])


def _signed_volumes(vertices: Vertices, faces: Faces) -> Float[np.ndarray, " faces"]:
    """Return the volume between each triangle and the middle, negative where it faces that."""
    a, b, c = (vertices - vertices.mean(axis=0))[faces].swapaxes(0, 1)
    return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)
