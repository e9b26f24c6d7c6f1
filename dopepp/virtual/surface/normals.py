"""A mesh's connections: merged vertices, smooth normals with sharp creases, smooth patches."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.core.compiled import Array, compiled
from dopepp.parts.mesh.measure import Faces, Vertices

_MERGE_STEPS: Final = 2**21 - 1
"""Vertices of one cell of a grid so fine across the mesh are one (STL and UV seams split them);
three such coordinates fit into one integer of 64 bits."""

_MOST_CORNERS: Final = 1024
"""Normals around a vertex of more corners are not averaged: that takes the square of the number."""


def merge_vertices(vertices: Vertices) -> Int[np.ndarray, "vertices"]:
    """Number vertices so that equal positions share a number."""
    step = max(float(np.ptp(vertices, axis=0).max()), 1e-12) / _MERGE_STEPS
    cells = np.round((vertices - vertices.min(axis=0)) / step).astype(np.int64)
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    return np.asarray(np.unique(keys, return_inverse=True)[1].reshape(-1), np.int64)


def is_closed(merged: Faces, triangles: Float[np.ndarray, "faces 3 3"]) -> bool:
    """Tell whether every directed edge has exactly one opposite and the volume is positive."""
    collapsed = (merged == merged[:, [1, 2, 0]]).any(axis=1)
    start, end = merged[~collapsed], merged[~collapsed][:, [1, 2, 0]]
    count = int(merged.max()) + 1
    forward = np.sort((start * count + end).reshape(-1))
    if len(forward) == 0 or (forward[1:] == forward[:-1]).any():
        return False
    if not np.array_equal(forward, np.sort((end * count + start).reshape(-1))):
        return False
    a, b, c = (triangles - triangles.reshape(-1, 3).mean(axis=0)).transpose(1, 0, 2)
    return bool(np.einsum("ij,ij->", a, np.cross(b, c)) > 0)


def corner_normals(
    merged: Faces,
    doubled: Float[np.ndarray, "faces 3"],
    length: Float[np.ndarray, "faces"],
    edges: Float[np.ndarray, "faces 3 3"],
    crease_angle_deg: float,
) -> Float[np.ndarray, "faces 3 3"]:
    """Return angle-weighted corner normals (Thürmer and Wüthrich 1998) with creases.

    ``merged`` is the merged vertex of every corner; ``doubled`` the cross product of two ``edges``
    of every face (its normal, twice its area long), ``length`` its length. Faces that meet at more
    than ``crease_angle_deg`` keep a sharp edge.
    """
    face_normals = doubled / np.maximum(length, 1e-300)[:, None]
    unit = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-300)
    cosines = -(unit * unit[:, [2, 0, 1]]).sum(axis=2)
    weights = np.arccos(np.clip(cosines, -1.0, 1.0)) * (length > 0)[:, None]
    corners = np.argsort(merged.reshape(-1), kind="stable")
    counts = np.bincount(merged.reshape(-1), minlength=int(merged.max()) + 1)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    normals = np.empty((len(merged), 3, 3), np.float32)
    cosine = float(np.cos(np.radians(crease_angle_deg)))
    _average_normals(face_normals, weights, offsets, corners, cosine, normals)
    return normals


@compiled()
def _average_normals(
    face_normals: Array, weights: Array, offsets: Array, corners: Array, cosine: float, out: Array
) -> None:
    """Average, at every corner, the normals of the faces around its vertex within an angle.

    Faces have unit normals, zero for degenerate ones, and corners ``weights`` (their angles), both
    of shape (F, 3). ``corners`` are the numbers 3·face + k sorted by vertex, shape (3F,), of which
    each vertex's start at ``offsets``, shape (V + 1,). Faces that differ by more than ``cosine``
    are not averaged. ``out`` are normals, shape (F, 3, 3), float32.
    """
    for vertex in range(offsets.shape[0] - 1):
        for p in range(offsets[vertex], offsets[vertex + 1]):
            face, k = corners[p] // 3, corners[p] % 3
            nx, ny, nz = face_normals[face, 0], face_normals[face, 1], face_normals[face, 2]
            sx, sy, sz = 0.0, 0.0, 0.0
            # Every pair of a vertex's faces is compared; a hub of a million faces is left flat.
            first, last = offsets[vertex], offsets[vertex + 1]
            if last - first > _MOST_CORNERS:
                first, last = p, p + 1
            for q in range(first, last):
                other, m = corners[q] // 3, corners[q] % 3
                ox, oy, oz = face_normals[other, 0], face_normals[other, 1], face_normals[other, 2]
                if nx * ox + ny * oy + nz * oz >= cosine:
                    sx += weights[other, m] * ox
                    sy += weights[other, m] * oy
                    sz += weights[other, m] * oz
            norm = math.sqrt(sx * sx + sy * sy + sz * sz)
            if norm > 0.0:
                out[face, k, 0], out[face, k, 1], out[face, k, 2] = sx / norm, sy / norm, sz / norm
            else:
                out[face, k, 0], out[face, k, 1], out[face, k, 2] = nx, ny, nz


def smooth_patches(
    corners: Faces, normals: Float[np.ndarray, "faces 3 3"], usable: Bool[np.ndarray, "faces"]
) -> Int[np.ndarray, "faces"]:
    """Number faces so that those connected by edges without a crease share a number.

    ``corners`` are vertices; where attributes differ, vertices must too. An edge is smooth where
    the normals of both its faces agree. ``usable`` is False for faces without an area, which
    connect nothing.
    """
    count = int(corners.max()) + 1
    start, end = corners, corners[:, [1, 2, 0]]
    keys = (np.minimum(start, end) * np.int64(count) + np.maximum(start, end)).reshape(-1)
    order = np.argsort(keys, kind="stable")
    patches = np.arange(len(corners), dtype=np.int32)
    _join(keys[order], order, corners, normals, usable, patches)
    return patches


@compiled()
def _join(
    keys: Array, order: Array, corners: Array, normals: Array, usable: Array, patches: Array
) -> None:
    """Join faces that share an edge and its normals (union-find with path halving)."""
    for p in range(1, keys.shape[0]):
        if keys[p] != keys[p - 1]:
            continue
        one, other = order[p - 1] // 3, order[p] // 3
        if not (usable[one] and usable[other]):
            continue
        smooth = True
        for k in range(3):
            for m in range(3):
                if corners[one, k] == corners[other, m]:
                    dot = 0.0
                    for r in range(3):
                        dot += normals[one, k, r] * normals[other, m, r]
                    smooth = smooth and dot > 0.999
        if smooth:
            while patches[one] != one:
                patches[one] = patches[patches[one]]
                one = patches[one]
            while patches[other] != other:
                patches[other] = patches[patches[other]]
                other = patches[other]
            patches[max(one, other)] = min(one, other)
    for f in range(patches.shape[0]):
        patches[f] = patches[patches[f]]
