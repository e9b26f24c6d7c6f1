"""The sky over a supporting plane: the soft darkening around an object that touches it.

Points spread over the objects stand for them. In each of 32 directions into the sky, spread with
the cosine, every point hides the sky from one spot of the plane; one bit per direction and cell
says so, and the share of bits is the share of the sky.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float

from dopepp.compiled import Array, compiled
from dopepp.virtual.scene import SceneObject

_CELLS: Final = 80
"""Cells across the longer side of the grid on which the sky over the plane is measured."""

_SKY_DIRECTIONS: Final = 32
"""Directions in which the sky is looked at, one bit each."""

_MARGIN: Final = 2.0
"""Of the grid around the objects, in units of their height; beyond it little sky is hidden."""

_SPLAT: Final = 0.8
"""Half the side of a point's spot over the points' spacing; so wide that spots leave no gaps."""


def hidden_sky(
    frame: Float[np.ndarray, "3 4"], objects: Sequence[SceneObject]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "rows columns"]] | None:
    """Return the share of a plane's sky that objects hide; None if they are all below it.

    Args:
        frame: Maps camera-frame points to (x, y) on the plane and the height above it, metres.
        objects: What may stand on the plane.

    Returns:
        (x, y) of the grid's first cell and a cell's side, metres; and the shares.
    """
    places = []
    for item in objects:
        cam = item.surface.points @ item.T_cam_obj[:3, :3].T + item.T_cam_obj[:3, 3]
        points = cam @ frame[:, :3].T + frame[:, 3]
        places.append(points[points[:, 2] > 0])
    everything = np.concatenate(places) if places else np.zeros((0, 3))
    if len(everything) == 0:
        return None
    margin = _MARGIN * float(everything[:, 2].max())
    low, high = everything[:, :2].min(axis=0) - margin, everything[:, :2].max(axis=0) + margin
    cell = float((high - low).max()) / _CELLS
    columns, rows = (math.ceil(side) + 1 for side in (high - low) / cell)
    bits, own = np.zeros((rows, columns), np.uint32), np.empty((rows, columns), np.uint32)
    grid = np.array([low[0], low[1], cell])
    for item, points in zip(objects, places, strict=True):
        own[:] = 0
        reach = max(_SPLAT * item.surface.spacing / cell, 0.5)
        _splat(points, reach, _SKY_SLOPES, grid, own)
        _shrink(own, round(reach - 0.5), bits)
    hidden = np.empty((rows, columns), np.float32)
    _count(bits, hidden)
    hidden = cv2.blur(hidden / _SKY_DIRECTIONS, (3, 3))
    # A little is left at the grid's border; it is faded out over half of the margin.
    edges = (
        np.minimum(np.arange(side), np.arange(side)[::-1]) / (0.5 * margin / cell)
        for side in (rows, columns)
    )
    hidden *= np.minimum(np.minimum.outer(*edges), 1.0).astype(np.float32)
    return grid, np.asarray(hidden)


def _sky_slopes() -> Float[np.ndarray, "directions 2"]:
    """Return directions into the sky as (x, y)/z, spread with the cosine (Malley's method)."""
    k = np.arange(_SKY_DIRECTIONS) + 0.5
    radius, angle = np.sqrt(k / _SKY_DIRECTIONS), k * np.pi * (1 + np.sqrt(5))
    height = np.sqrt(1 - radius**2)
    slopes = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.asarray(slopes / height[:, None])


_SKY_SLOPES: Final = _sky_slopes()


@compiled()
def _splat(points: Array, reach: float, slopes: Array, grid: Array, bits: Array) -> None:
    """Set a direction's bit in the cells, up to a reach, from which a point hides it."""
    rows, columns = bits.shape
    for p in range(points.shape[0]):
        for k in range(slopes.shape[0]):
            x = (points[p, 0] - slopes[k, 0] * points[p, 2] - grid[0]) / grid[2]
            y = (points[p, 1] - slopes[k, 1] * points[p, 2] - grid[1]) / grid[2]
            if not (-reach < x < columns - 1 + reach and -reach < y < rows - 1 + reach):
                continue
            bit = np.uint32(1 << k)
            left, right = max(math.ceil(x - reach), 0), min(math.floor(x + reach), columns - 1)
            top, bottom = max(math.ceil(y - reach), 0), min(math.floor(y + reach), rows - 1)
            for j in range(top, bottom + 1):
                for i in range(left, right + 1):
                    bits[j, i] |= bit


@compiled()
def _shrink(bits: Array, cells: int, out: Array) -> None:
    """Take from every direction's spot what its splats stick out, and add it to the others'."""
    rows, columns = bits.shape
    row = np.empty_like(bits)
    for j in range(rows):
        for i in range(columns):
            value = bits[j, i]
            for k in range(max(i - cells, 0), min(i + cells, columns - 1) + 1):
                value &= bits[j, k]
            row[j, i] = value
    for j in range(rows):
        for i in range(columns):
            value = row[j, i]
            for k in range(max(j - cells, 0), min(j + cells, rows - 1) + 1):
                value &= row[k, i]
            out[j, i] |= value


@compiled()
def _count(bits: Array, out: Array) -> None:
    """Count the bits of every cell."""
    for j in range(bits.shape[0]):
        for i in range(bits.shape[1]):
            value, count = bits[j, i], 0
            while value:
                value &= value - np.uint32(1)
                count += 1
            out[j, i] = count
