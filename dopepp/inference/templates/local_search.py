"""Local search of poses and views for matches with a larger edge response.

The functions share the names of their arrays: ``maps`` are edge responses by orientation, row and
column; ``points`` (diameters) and ``normals`` (radians) are the edge points of a view; ``poses``
has column, row, in-plane rotation and projected diameter of each match.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dopepp.core.compiled import Array, compiled
from dopepp.inference.templates.responses import orientation_bin
from dopepp.inference.templates.views import Templates

ROLL_STEP: Final = math.radians(5.0)  # step of the in-plane rotation on the grid
GROWTH: Final = 0.03  # first relative step of the size
FEW: Final = 32  # number of a template's points compared on the grid: its first, far apart
REACH_PX: Final = 1.5  # first step of the position after a change of view
MAX_CHANGES: Final = 4  # largest number of changes of a match's view


@compiled(fastmath=True)
def _place(
    points: Array, normals: Array, roll: float, scale: float, offsets: Array, bins: Array
) -> None:
    """Rotate and scale a template: write the offsets of its points and their orientations.

    ``offsets`` (2, points) are relative to the template's centre, pixels.
    """
    c, s = scale * math.cos(roll), scale * math.sin(roll)
    for p in range(len(bins)):
        offsets[0, p] = c * points[p, 0] - s * points[p, 1]
        offsets[1, p] = s * points[p, 0] + c * points[p, 1]
        bins[p] = orientation_bin(normals[p] + roll)


@compiled(fastmath=True)
def _response(
    maps: Array, offsets: Array, bins: Array, u: float, v: float, indices: Array
) -> float:
    """Return the mean edge response at the points of a template with its centre at pixel (u, v).

    ``indices`` is a workspace of 32-bit integers, as maps have less than 2³¹ elements. A separate
    loop computes the indices, so that the compiler vectorises it.
    """
    height, width, total = np.int32(maps.shape[1]), np.int32(maps.shape[2]), 0
    flat = maps.reshape(-1)
    for p in range(len(bins)):
        x, y = np.int32(u + offsets[0, p] + 0.5), np.int32(v + offsets[1, p] + 0.5)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        indices[p] = (bins[p] * height + y) * width + x if inside else np.int32(-1)
    for p in range(len(bins)):
        if indices[p] >= 0:
            total += flat[indices[p]]
    return total / len(bins)


@compiled()
def _workspace(count: int) -> tuple[Array, Array, Array]:
    """Return arrays for two placements of a template with ``count`` points.

    Returns:
        ``offsets`` and ``bins`` of :func:`_place` for both, and ``indices`` of :func:`_response`.
    """
    return np.empty((2, 2, count)), np.empty((2, count), np.int32), np.empty(count, np.int32)


@compiled(fastmath=True)
def _climb(
    maps: Array,
    points: Array,
    normals: Array,
    pose: Array,
    reach: float,
    rounds: int,
    workspace: tuple[Array, Array, Array],
) -> float:
    """Maximise the response over the four numbers of a pose, changing one number at a time.

    Args:
        maps: Responses.
        points: Points of the template.
        normals: Direction of each point's normal.
        pose: Pose, updated in place.
        reach: First step of the position, pixels.
        rounds: Number of rounds; each has smaller steps.
        workspace: Result of :func:`_workspace`.

    Returns:
        The highest response.
    """
    used, (offsets, bins, indices) = 0, workspace
    _place(points, normals, pose[2], pose[3], offsets[used], bins[used])
    most = _response(maps, offsets[used], bins[used], pose[0], pose[1], indices)
    steps = np.array([reach, reach, ROLL_STEP / 2, GROWTH * pose[3]])
    for _ in range(rounds):
        for axis in range(4):
            for sign in (-1.0, 1.0):
                pose[axis] += sign * steps[axis]
                trial = used
                if axis >= 2:  # the offsets depend on rotation and size only
                    trial = 1 - used
                    _place(points, normals, pose[2], pose[3], offsets[trial], bins[trial])
                value = _response(maps, offsets[trial], bins[trial], pose[0], pose[1], indices)
                if value > most:
                    most, used = value, trial
                else:
                    pose[axis] -= sign * steps[axis]
        steps *= 0.6
    return most


@compiled(fastmath=True)
def search_nearby(
    maps: Array, templates: Templates, views: Array, poses: Array, reach: float, best: Array
) -> None:
    """Move each match to the highest response nearby: first on a grid, then by :func:`_climb`.

    ``reach`` is half the side of the grid, pixels. ``poses`` is updated in place, and ``best`` is
    filled with the response of each match.
    """
    height, width = maps.shape[1], maps.shape[2]
    points, normals = templates.points, templates.normals
    workspace = _workspace(points.shape[1])
    offsets, bins = workspace[0][0], workspace[1][0]
    columns, rows, sums = np.empty(5, np.int64), np.empty(5, np.int64), np.empty((5, 5), np.int64)
    for i in range(len(views)):
        edges, angles, scale = points[views[i]], normals[views[i]], poses[i, 3]
        u, v, roll, most = poses[i, 0], poses[i, 1], poses[i, 2], -FEW * 128 - 1
        for k in range(-1, 2):
            angle = roll + k * ROLL_STEP
            _place(edges, angles, angle, scale, offsets, bins[:FEW])
            sums[:] = 0
            for p in range(FEW):
                for n in range(5):
                    shift = (n - 2) * reach / 2
                    columns[n] = int(u + shift + offsets[0, p] + 0.5)
                    rows[n] = int(v + shift + offsets[1, p] + 0.5)
                for n in range(5):
                    for m in range(5):
                        x, y = columns[n], rows[m]
                        if 0 <= x < width and 0 <= y < height:
                            sums[n, m] += maps[bins[p], y, x]
            for n in range(5):
                for m in range(5):
                    if sums[n, m] > most:
                        most, poses[i, 2] = sums[n, m], angle
                        poses[i, 0], poses[i, 1] = u + (n - 2) * reach / 2, v + (m - 2) * reach / 2
        best[i] = _climb(maps, edges, angles, poses[i], reach / 4, 3, workspace)


@compiled(fastmath=True)
def replace_views(
    maps: Array, templates: Templates, views: Array, poses: Array, responses: Array
) -> None:
    """Replace the view of each match by the neighbour with the largest response, repeatedly.

    ``views`` and ``poses`` are updated in place, and ``responses`` is filled with the response of
    each match.
    """
    points, normals = templates.points, templates.normals
    neighbours, twists = templates.neighbours, templates.twists
    pose, best = np.empty(4), np.empty(4)
    workspace = _workspace(points.shape[1])
    for i in range(len(views)):
        best[:] = poses[i]
        most = _climb(maps, points[views[i]], normals[views[i]], best, REACH_PX, 2, workspace)
        for _ in range(MAX_CHANGES):
            view, chosen = views[i], views[i]
            poses[i] = best
            for k in range(neighbours.shape[1]):
                other = neighbours[view, k]
                pose[:] = poses[i]
                pose[2] += twists[view, k]
                value = _climb(maps, points[other], normals[other], pose, REACH_PX, 2, workspace)
                if value > most:
                    most, chosen = value, other
                    best[:] = pose
            if chosen == view:
                break
            views[i] = chosen
        poses[i], responses[i] = best, most
