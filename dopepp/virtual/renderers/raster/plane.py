"""Shadows of objects on the image of a supporting plane.

The background shows the plane in full light and is multiplied by the share of light (sky and lamps)
that objects do not block. Homographies warp each shadow map and the sky's grid into the image.

Points on the objects' surfaces hide the sky in 32 cosine-distributed directions. Each point sets
one bit per direction in a cell of the plane. The share of bits is the hidden share of the sky and
gives soft contact shadows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy.lib.stride_tricks import sliding_window_view

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import transform
from dopepp.geometry.rotation import Vector, rotation_to_z
from dopepp.virtual.renderers.raster.visibility import Box, Samples, ShadowMap
from dopepp.virtual.scene import NEAR, Plane, Scene, SceneObject
from dopepp.virtual.sensor import CODE_STEPS, LINEAR_TO_SRGB, SRGB_TO_LINEAR
from dopepp.virtual.triangles import NUM_COLOUR_SAMPLES, scratch

_VISIBLE: Final = np.float32(0.005)  # smallest share of hidden light that changes an 8-bit image

_SKY_DIRECTIONS: Final = 32  # sampled directions of the sky, one bit each
_SKY_CELLS: Final = 80  # cells along the longer side of the grid

_ZERO, _ONE = np.float32(0), np.float32(1)


class _LitPlane(NamedTuple):
    """A plane and its lights for compiled code, float32."""

    to_point: Array  # Map from a pixel to its point on the plane and 1/z, shape (4, 3)
    normal: Array  # Unit normal, camera frame
    sky: Array  # Linear RGB of the ambient light on the plane
    lights: Array  # Position and colour of every light, see :class:`ShadowMap`, shape (lights, 6)
    P: Array  # Projection of every shadow map, see :class:`ShadowMap`, shape (lights, 3, 4)


def darken_plane(
    scene: Scene, plane: Plane, lights: Sequence[ShadowMap], samples: Samples, image: Array
) -> None:
    """Darken the image in place where objects shadow the plane and do not fill the pixel."""
    # Camera frame to (x, y) on the plane and the height above it, metres.
    rotation = rotation_to_z(np.array(plane.normal, np.float64))
    frame = np.column_stack([rotation, [0.0, 0.0, -plane.offset]])
    sky = hidden_sky(frame, scene.objects)
    if sky is None:
        return
    grid, hidden = sky
    casts = [_soft_shadow(plane, shadow) for shadow in lights]
    blurs = [margin * shadow.texel for shadow, (_, margin) in zip(lights, casts, strict=True)]
    box = _shadowed_box(scene, frame, grid, hidden.shape, lights, blurs)
    if box is None:
        return
    inverse = plane.inverse_depth_row(scene.K)
    # A pixel (u, v, 1) shows the plane's point K⁻¹ (u, v, 1) / (inverse · (u, v, 1)).
    to_point = np.vstack([np.linalg.inv(scene.K), inverse])
    to_cells = np.array([[1, 0, -grid[0]], [0, 1, -grid[1]], [0, 0, grid[2]]])
    to_plane = np.vstack([frame[:2] @ to_point, inverse])
    shades = scratch("shades", (1 + len(lights), box[3] - box[1], box[2] - box[0]), np.float32)
    _warp(hidden, to_cells @ to_plane, box, shades[0])
    for shadow, (cast, margin), shade in zip(lights, casts, shades[1:], strict=True):
        to_map = np.array([[1, 0, margin], [0, 1, margin], [0, 0, 1]]) @ shadow.P
        _warp(cast, to_map @ to_point, box, shade)
    lit = _LitPlane(
        to_point.astype(np.float32),
        np.array(plane.normal, np.float32),
        np.asarray(scene.ambient.light_on(np.array(plane.normal)), np.float32),
        np.array([shadow.light for shadow in lights], np.float32).reshape(-1, 6),
        np.array([shadow.P for shadow in lights], np.float32).reshape(-1, 3, 4),
    )
    _darken(box[:2], lit, shades, SRGB_TO_LINEAR, LINEAR_TO_SRGB, samples, image)


def _soft_shadow(
    plane: Plane, shadow: ShadowMap
) -> tuple[Float32[np.ndarray, "rows columns"], int]:
    """Return a shadow map's blocked share of light, with penumbra, and the added margin, texels."""
    P = shadow.P.astype(np.float64)
    # The plane's 1/depth is linear in the map as well: n · x = offset with x = M⁻¹ (depth (u, v, 1)
    # − p), P = [M | p].
    row = np.array(plane.normal) @ np.linalg.inv(P[:, :3])
    span = plane.offset + float(row @ P[:, 3])
    rows, columns = shadow.inverse_depth.shape[:2]
    if abs(span) < 1e-12:
        return np.zeros((rows, columns), np.float32), 0  # the light lies in the plane
    ground = np.add.outer(
        (row[1] * np.arange(rows) + row[2]) / span, row[0] * np.arange(columns) / span
    )
    drawn = shadow.inverse_depth[..., 0]
    cast = (drawn > np.maximum(ground, 0.0)).astype(np.float32)
    hit = (cast > 0) & (ground > 0)
    if not hit.any():
        return cast, 0
    # The penumbra's width is the lamp's angular size, seen from the object, times the gap.
    gap = float(np.median(1 / ground[hit] - 1 / drawn[hit]))
    texel = shadow.texel * float(np.median(1 / ground[hit]))
    # Seen from the plane, a lamp is 0.04 rad wide. The map's outlines are not anti-aliased: a blur
    # of at least 0.7 texels makes them smooth.
    sigma = min(max(0.25 * 0.04 * gap / texel, 0.7), max(rows, columns) / 16)
    margin = math.ceil(3 * sigma)
    cast = cv2.copyMakeBorder(cast, *4 * (margin,), cv2.BORDER_CONSTANT, value=0.0)
    return np.asarray(cv2.GaussianBlur(cast, (0, 0), sigma)), margin


def _warp(source: Array, to_source: Array, box: Box, out: Array) -> None:
    """Fill ``out``, the pixels of a box, from ``source`` by a homography; 0 outside the source."""
    shift = np.array([[1.0, 0.0, box[0]], [0.0, 1.0, box[1]], [0.0, 0.0, 1.0]])
    size = (box[2] - box[0], box[3] - box[1])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    cv2.warpPerspective(source, to_source @ shift, size, dst=out, flags=flags)


def _shadowed_box(
    scene: Scene,
    frame: Float[np.ndarray, "3 4"],
    grid: Vector,
    cells: tuple[int, ...],
    lights: Sequence[ShadowMap],
    blurs: Sequence[float],
) -> Box | None:
    """Return the box of pixels that shadows may darken, or None.

    ``blurs`` are the widths by which shadows are blurred, metres per metre of distance to the lamp.
    """
    size = scene.size
    right, bottom = grid[0] + cells[1] * grid[2], grid[1] + cells[0] * grid[2]
    corners = np.array([(x, y, 0.0) for x in (grid[0], right) for y in (grid[1], bottom)])
    spots = [(corners - frame[:, 3]) @ frame[:, :3]]
    for lamp, blur in zip((shadow.light[:3] for shadow in lights), blurs, strict=True):
        lamp_height = lamp @ frame[2, :3] + frame[2, 3]
        for item in scene.objects:
            hull = transform(item.T_cam_obj, item.surface.hull)
            height = hull @ frame[2, :3] + frame[2, 3]
            above = height > 0
            if not above.any() or lamp_height <= 0:
                continue
            if (height[above] >= 0.999 * lamp_height).any():
                return 0, 0, *size  # the shadow has no end
            stretch = lamp_height / (lamp_height - height[above])
            ends = lamp + stretch[:, None] * (hull[above] - lamp)
            # A blur is longest along the light, where the plane stretches it.
            reach = blur * np.square(ends - lamp).sum(axis=1, keepdims=True) / lamp_height
            along, across = frame[:2, :3]
            spots += [ends + reach * (i * along + j * across) for i in (-1, 1) for j in (-1, 1)]
    points = np.concatenate(spots)
    if (points[:, 2] <= NEAR).any():
        return 0, 0, *size
    pixels = points @ scene.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    low = np.clip(np.floor(pixels.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int)
    box = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    return box if box[0] < box[2] and box[1] < box[3] else None


def hidden_sky(
    frame: Float[np.ndarray, "3 4"], objects: Sequence[SceneObject]
) -> tuple[Vector, Float[np.ndarray, "rows columns"]] | None:
    """Return the share of the sky over a plane that objects hide; None if all are below the plane.

    ``frame`` maps the camera frame to (x, y) on the plane and the height above it, metres.

    Returns:
        Position (x, y) of the grid's first cell and a cell's side, metres; hidden share per cell.
    """
    heights = []
    for item in objects:
        points = transform(item.T_cam_obj, item.surface.points) @ frame[:, :3].T + frame[:, 3]
        heights.append(points[points[:, 2] > 0])
    everything = np.concatenate(heights) if heights else np.zeros((0, 3))
    if len(everything) == 0:
        return None
    # Beyond twice the objects' height, little sky is hidden.
    margin = 2 * float(everything[:, 2].max())
    low, high = everything[:, :2].min(axis=0) - margin, everything[:, :2].max(axis=0) + margin
    cell = float((high - low).max()) / _SKY_CELLS
    columns, rows = (math.ceil(side) + 1 for side in (high - low) / cell)
    bits, splats = np.zeros((rows, columns), np.uint32), np.empty((rows, columns), np.uint32)
    grid = np.array([low[0], low[1], cell])
    # Directions into the sky as (x, y)/z, spread with the cosine (Malley's method).
    k = np.arange(_SKY_DIRECTIONS) + 0.5
    radius, angle = np.sqrt(k / _SKY_DIRECTIONS), k * np.pi * (1 + np.sqrt(5))
    slopes = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    slopes = slopes / np.sqrt(1 - radius**2)[:, None]
    for item, points in zip(objects, heights, strict=True):
        splats[:] = 0
        # Half the side of a splat, so wide that splats leave no gaps; at most the whole grid.
        reach = min(max(0.8 * item.surface.spacing / cell, 0.5), _SKY_CELLS)
        _splat(points, reach, slopes, grid, splats)
        # Erode by the splats' overhang.
        cells = round(reach - 0.5)
        padded = np.pad(splats, cells, constant_values=np.iinfo(np.uint32).max)
        windows = sliding_window_view(padded, (2 * cells + 1, 2 * cells + 1))
        bits |= np.bitwise_and.reduce(windows, axis=(2, 3))
    counts = np.unpackbits(bits.view(np.uint8), axis=1).reshape(rows, columns, -1).sum(axis=-1)
    hidden = cv2.blur(counts.astype(np.float32) / _SKY_DIRECTIONS, (3, 3))
    # Fade out over half of the margin, so that the grid's border does not show.
    edges = (
        np.minimum(np.arange(side), np.arange(side)[::-1]) / (0.5 * margin / cell)
        for side in (rows, columns)
    )
    hidden *= np.minimum(np.minimum.outer(*edges), 1.0).astype(np.float32)
    return grid, np.asarray(hidden)


@compiled()
def _splat(points: Array, reach: float, slopes: Array, grid: Array, bits: Array) -> None:
    """Set a bit per direction of light in the cells that points (x, y, height) shade.

    ``reach`` is the half-width of a point's shadow in cells, and ``slopes`` the displacement (x, y)
    of the shadow per height for each direction.
    """
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


@compiled(fastmath=True)
def _darken(
    corner: tuple[int, int],
    lit: _LitPlane,
    shades: Array,
    decode: Array,
    encode: Array,
    samples: Samples,
    image: Array,
) -> None:
    """Multiply the image in place by the share of the plane's light that remains.

    ``shades`` (1 + lights, h, w) are the hidden shares of the sky and of every light from the pixel
    ``corner`` on; ``decode`` and ``encode`` are the tables between sRGB codes and linear light.
    """
    origin, _, ids = samples
    to_point, width = lit.to_point, shades.shape[2]
    total, lost = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    for j in range(shades.shape[1]):
        if shades[:, j].max() > _VISIBLE:
            v = corner[1] + j
            _light_row(corner, j, lit, shades, total, lost)
            for i in range(width):
                u = corner[0] + i
                inverse = to_point[3, 0] * u + to_point[3, 1] * v + to_point[3, 2]
                if not 0.0 < inverse * NEAR <= 1.0 or _is_full(ids, v - origin[1], u - origin[0]):
                    continue
                for c in range(3):
                    if lost[c, i] > _VISIBLE * total[c, i]:
                        kept = max(_ONE - lost[c, i] / total[c, i], _ZERO)
                        step = int(decode[image[v, u, c]] * kept * CODE_STEPS + 0.5)
                        image[v, u, c] = np.uint8(encode[step] + 0.5)


@compiled()
def _is_full(ids: Array, j: int, i: int) -> bool:
    """Return whether objects cover all samples of a pixel."""
    if not (0 <= j < ids.shape[0] and 0 <= i < ids.shape[1]):
        return False
    full = True
    for s in range(NUM_COLOUR_SAMPLES):
        full = full and ids[j, i, s] >= 0
    return full


@compiled(fastmath=True)
def _light_row(
    corner: tuple[int, int], j: int, lit: _LitPlane, shades: Array, total: Array, lost: Array
) -> None:
    """Fill ``total`` with the light on row j without objects, ``lost`` with its blocked part."""
    to_point, normal, sky, lights, P = lit
    fv = np.float32(corner[1] + j)
    px, py = to_point[0, 1] * fv + to_point[0, 2], to_point[1, 1] * fv + to_point[1, 2]
    pw, mx = to_point[3, 1] * fv + to_point[3, 2], to_point[0, 0]
    my, mw = to_point[1, 0], to_point[3, 0]
    nx, ny, nz = normal[0], normal[1], normal[2]
    for c in range(3):
        for i in range(total.shape[1]):
            total[c, i] = sky[c]
            lost[c, i] = sky[c] * shades[0, j, i]
    for k in range(lights.shape[0]):
        x0, y0, z0 = lights[k, 0], lights[k, 1], lights[k, 2]
        red, green, blue = lights[k, 3], lights[k, 4], lights[k, 5]
        a, b, c, d = P[k, 2, 0], P[k, 2, 1], P[k, 2, 2], P[k, 2, 3]
        for i in range(total.shape[1]):
            u = np.float32(corner[0] + i)
            z = _ONE / (mw * u + pw)
            x, y = (mx * u + px) * z, (my * u + py) * z
            lx, ly, lz = x0 - x, y0 - y, z0 - z
            facing = max(nx * lx + ny * ly + nz * lz, _ZERO)
            square = lx * lx + ly * ly + lz * lz
            strength = facing / (square * math.sqrt(square))
            # The homography also maps points behind the light into its map.
            shade = strength * shades[1 + k, j, i] if a * x + b * y + c * z + d > _ZERO else _ZERO
            total[0, i] += strength * red
            total[1, i] += strength * green
            total[2, i] += strength * blue
            lost[0, i] += shade * red
            lost[1, i] += shade * green
            lost[2, i] += shade * blue
