"""Look-alikes: parts that resemble a target but must not be detected.

A uniformly scaled copy is not a look-alike, because one camera cannot distinguish it from the part
at another distance. To add a look-alike, yield its mesh from ``_meshes``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.parts.mesh import Faces, SurfaceTree, Vertices, half_sphere
from dopepp.parts.part import Mesh, Part, make_part

STRETCH: Final = 1.3  # factor on the longest side of the stretched copy
_CUT_SHARE: Final = 0.25  # Share of the surface that the cut removes
_OWN_MIRROR: Final = 0.015  # Largest mirror distance of a part that equals its mirror image


def lookalikes(parts: Sequence[Part]) -> list[Part]:
    """Return look-alikes of parts: mirrored, stretched along the longest side, with an end cut off.

    A part that equals its mirror image has no mirrored copy. Parts without a mesh are ignored.
    """
    return [
        make_part(f"{part.name}, {kind}", mesh)
        for part in parts
        if part.mesh is not None
        for kind, mesh in _meshes(part.mesh)
    ]


def mirror_distance(mesh: Mesh) -> float:
    """Return the least mean distance of a surface to its reflections, bounding-sphere diameters.

    The search covers reflections at planes through the centroid and at the centroid itself; a part
    with another improper symmetry counts as chiral.
    """
    surface = SurfaceTree(mesh.vertices, mesh.faces)
    centre = surface.areas @ surface.triangles.mean(axis=1) / surface.areas.sum()
    probes = surface.spread(120, seed=0)[0] - centre
    diameter = 2 * float(np.linalg.norm(probes, axis=1).max())

    def distances(reflected: Float[np.ndarray, "ways probes 3"]) -> Float[np.ndarray, " ways"]:
        return np.asarray(surface.distances(reflected + centre, neighbours=1).mean(axis=1))

    rng = np.random.default_rng(0)
    normals, reach = half_sphere(600), 0.06
    best, least = normals[0], np.inf
    for _ in range(6):
        along = probes @ normals.T
        errors = distances(probes - 2 * along.T[:, :, None] * normals[:, None])
        if errors.min() < least:
            best, least = normals[errors.argmin()], float(errors.min())
        normals = best + reach * rng.normal(size=(40, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        reach /= 3
    return min(least, float(distances(-probes[None])[0])) / diameter


def _meshes(mesh: Mesh) -> Iterator[tuple[str, Mesh]]:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    if mirror_distance(mesh) > _OWN_MIRROR:
        mirrored = mesh.vertices * (-1.0, 1.0, 1.0)
        # A reflection turns triangles inside out.
        yield "mirrored", _replace_triangles(mesh, mirrored, mesh.faces[:, ::-1])
    longest = int((high - low).argmax())
    stretch = np.where(np.arange(3) == longest, STRETCH, 1.0)
    yield "stretched", _replace_triangles(mesh, mesh.vertices * stretch, mesh.faces)
    # Vertices beyond the plane move into it, so the surface stays closed and keeps its colours.
    points = SurfaceTree(mesh.vertices, mesh.faces).spread(2000, seed=0)[0]
    normal = np.where(
        np.arange(3) == (high - low).argmin(), 0.0, 1.0 / np.maximum(high - low, 1e-9)
    )
    normal /= np.linalg.norm(normal)
    offset = np.quantile(points @ normal, 1 - _CUT_SHARE)
    beyond = np.maximum(mesh.vertices @ normal - offset, 0.0)
    yield "cut", _replace_triangles(mesh, mesh.vertices - beyond[:, None] * normal, mesh.faces)


def _replace_triangles(mesh: Mesh, vertices: Vertices, faces: Faces) -> Mesh:
    """Return a mesh with other vertices and faces, and without the normals of the file."""
    return replace(mesh, vertices=vertices, faces=np.ascontiguousarray(faces), normals=None)
