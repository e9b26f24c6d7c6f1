"""Textures: an image pyramid with anisotropic filtering over each pixel's footprint.

A pixel's footprint on the texture is a parallelogram. Several probes cover its longer axis, each as
wide as the shorter axis and interpolated between the two nearest levels, so a grazing surface
neither shimmers nor blurs (McCormack et al., "Feline", 1999). Averages are of linear light. Unused
texels take the colour of their neighbours, so an atlas shows no seams from afar.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from dopepp.core.compiled import Array, compiled
from dopepp.drawing.pictures import RGBImage, Shape
from dopepp.parts.mesh import Faces
from dopepp.virtual.sensor import CODE_STEPS, LINEAR_TO_SRGB, SRGB_TO_LINEAR
from dopepp.virtual.triangles import CENTRE_SAMPLE, edge_functions, rasterise

Lookup = tuple[Array, Array, Array]

_MAX_PROBES: Final = 16  # along a footprint's longer axis; more stretched textures blur
_SHARPNESS: Final = 0.75  # a probe's width in footprint widths; interpolation widens it again


@dataclass(frozen=True, eq=False)
class Texture:
    """The image pyramid of a texture: levels of half the size each, down to one texel."""

    texels: UInt8[np.ndarray, "texels 3"]  # RGB of all levels, row by row, uint8, shape (n, 3)
    # First texel, rows and columns of every level, shape (levels, 3).
    levels: Int[np.ndarray, "levels 3"]

    def image(self, level: int = 0) -> UInt8[np.ndarray, "_ _ 3"]:
        """Return a level of the image pyramid as an RGB image; level 0 is the finest."""
        first, rows, columns = (int(value) for value in self.levels[level])
        return self.texels[first : first + rows * columns].reshape(rows, columns, 3)


def make_texture(image: RGBImage, uv: Float[np.ndarray, "vertices 2"], faces: Faces) -> Texture:
    """Return the image pyramid of a texture, from the texels that the faces use."""
    shapes = [image.shape[:2]]
    while max(shapes[-1]) > 1:
        shapes.append((max(shapes[-1][0] // 2, 1), max(shapes[-1][1] // 2, 1)))
    sizes = [rows * columns for rows, columns in shapes]
    firsts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    levels = np.column_stack([firsts, shapes]).astype(np.int64)
    texture = Texture(np.empty((sum(sizes), 3), np.uint8), levels)
    texture.image()[:] = image
    shares = [_used_texels(uv, faces, shapes[0])]
    for level in range(1, len(shapes)):
        shares.append(np.empty(shapes[level], np.float32))
        finer, coarser = texture.image(level - 1), texture.image(level)
        _halve(finer, shares[-2], SRGB_TO_LINEAR, LINEAR_TO_SRGB, coarser, shares[-1])
    # Unused texels take the colour of the next coarser level.
    for level in range(len(shapes) - 2, -1, -1):
        (rows, columns), coarser = shapes[level], texture.image(level + 1)
        j, i = np.nonzero(shares[level] == 0)
        colours = coarser[j * coarser.shape[0] // rows, i * coarser.shape[1] // columns]
        texture.image(level)[j, i] = colours
    return texture


def _used_texels(
    uv: Float[np.ndarray, "vertices 2"], faces: Faces, shape: Shape
) -> Float[np.ndarray, "_ _"]:
    """Return 1 at texels that a triangle touches, else 0; all 1 if the texture repeats."""
    rows, columns = shape
    used = uv[faces]
    if used.min() < 0.0 or used.max() > 1.0:
        return np.ones(shape, np.float32)  # the texture repeats: other copies may use a gap
    flat = np.ones((len(uv), 3))
    flat[:, 0], flat[:, 1] = uv[:, 0] * columns - 0.5, (1.0 - uv[:, 1]) * rows - 0.5
    touched, ids = np.zeros((rows, columns, 1), np.float32), np.empty((rows, columns, 1), np.int32)
    rasterise(flat, faces, False, 0.5, (0, 0), CENTRE_SAMPLE, touched, ids, 0)
    # Interpolation at a triangle's border reaches one texel beyond it.
    touched = cv2.dilate(touched[..., 0], np.ones((3, 3), np.uint8))
    return np.asarray(touched > 0, np.float32)


@compiled()
def _halve(
    source: Array, share: Array, decode: Array, encode: Array, out: Array, out_share: Array
) -> None:
    """Average the used texels of a level under every texel of the next, coarser level.

    ``share`` and ``out_share`` are the used shares of the texels; ``decode`` and ``encode`` are the
    tables between sRGB codes and linear light.
    """
    rows, columns = source.shape[:2]
    height, width = rows / out.shape[0], columns / out.shape[1]
    for j in range(out.shape[0]):
        top, bottom = j * height, (j + 1) * height
        for i in range(out.shape[1]):
            left, right = i * width, (i + 1) * width
            total, red, green, blue = 0.0, 0.0, 0.0, 0.0
            for y in range(int(top), min(math.ceil(bottom), rows)):
                tall = min(bottom, y + 1.0) - max(top, float(y))
                for x in range(int(left), min(math.ceil(right), columns)):
                    weight = tall * (min(right, x + 1.0) - max(left, float(x))) * share[y, x]
                    total += weight
                    red += weight * decode[source[y, x, 0]]
                    green += weight * decode[source[y, x, 1]]
                    blue += weight * decode[source[y, x, 2]]
            out_share[j, i] = total / (height * width)
            scale = CODE_STEPS / max(total, 1e-12)
            out[j, i, 0] = np.uint8(encode[min(int(red * scale + 0.5), CODE_STEPS)] + 0.5)
            out[j, i, 1] = np.uint8(encode[min(int(green * scale + 0.5), CODE_STEPS)] + 0.5)
            out[j, i, 2] = np.uint8(encode[min(int(blue * scale + 0.5), CODE_STEPS)] + 0.5)


@compiled(fastmath=True, inline="always")
def _bilinear(
    texels: Array, first: int, rows: int, columns: int, decode: Array, u: float, v: float
) -> tuple[float, float, float]:
    """Return the linear RGB of a repeating level at (u, v); v points up, and row 0 is the top.

    ``first`` is the level's first texel in ``texels`` (n, 3); ``decode`` maps sRGB codes to light.
    """
    x = (u - math.floor(u)) * columns - 0.5
    y = (1.0 - (v - math.floor(v))) * rows - 0.5
    i, j = math.floor(x), math.floor(y)
    x, y = x - i, y - j
    i0, j0 = i if i >= 0 else columns - 1, j if j >= 0 else rows - 1
    i1, j1 = i + 1 if i + 1 < columns else 0, j + 1 if j + 1 < rows else 0
    a, b = first + j0 * columns + i0, first + j0 * columns + i1
    c, d = first + j1 * columns + i0, first + j1 * columns + i1
    wa, wb, wc, wd = (1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y
    return (
        wa * decode[texels[a, 0]] + wb * decode[texels[b, 0]]
        + wc * decode[texels[c, 0]] + wd * decode[texels[d, 0]],
        wa * decode[texels[a, 1]] + wb * decode[texels[b, 1]]
        + wc * decode[texels[c, 1]] + wd * decode[texels[d, 1]],
        wa * decode[texels[a, 2]] + wb * decode[texels[b, 2]]
        + wc * decode[texels[c, 2]] + wd * decode[texels[d, 2]],
    )  # fmt: skip


@compiled(fastmath=True)
def sample_texture(
    points: tuple[Array, ...], hom: Array, faces: Array, uv: Array, texture: Lookup, out: Array
) -> None:
    """Sample the texture at an object's fragments, filtered over each pixel's footprint.

    ``points`` are the fragments' ``face``, ``share``, ``x`` and ``y``, ``hom`` the homogeneous
    pixels of the vertices, and ``texture`` the texels, levels and table from sRGB codes. ``out``
    (3, n) is filled with linear RGB.
    """
    face, share, x, y = points
    texels, levels, decode = texture
    last = levels.shape[0] - 1
    rows, columns = float(levels[0, 1]), float(levels[0, 2])
    for p in range(face.shape[0]):
        f = face[p] if face[p] >= 0 else ~face[p]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        e = edge_functions(hom, a, b, c)
        px, py = float(x[p]), float(y[p])
        total = (e[0] + e[3] + e[6]) * px + (e[1] + e[4] + e[7]) * py + (e[2] + e[5] + e[8])
        u = share[0, p] * uv[a, 0] + share[1, p] * uv[b, 0] + share[2, p] * uv[c, 0]
        v = share[0, p] * uv[a, 1] + share[1, p] * uv[b, 1] + share[2, p] * uv[c, 1]
        # u = (Σ e_k u_k)/(Σ e_k), both linear in the image; the derivatives are in texels.
        scale = 1.0 / total if total != 0.0 else 0.0
        au, bu, cu = uv[a, 0] - u, uv[b, 0] - u, uv[c, 0] - u
        av, bv, cv = uv[a, 1] - v, uv[b, 1] - v, uv[c, 1] - v
        ux = columns * scale * (e[0] * au + e[3] * bu + e[6] * cu)
        uy = columns * scale * (e[1] * au + e[4] * bu + e[7] * cu)
        vx = rows * scale * (e[0] * av + e[3] * bv + e[6] * cv)
        vy = rows * scale * (e[1] * av + e[4] * bv + e[7] * cv)
        # Axes of the ellipse that a pixel's disc maps to: eigenvectors of J Jᵀ.
        uu, vv, cross = ux * ux + uy * uy, vx * vx + vy * vy, ux * vx + uy * vy
        middle, half = 0.5 * (uu + vv), math.sqrt(0.25 * (uu - vv) ** 2 + cross * cross)
        major = math.sqrt(middle + half)
        minor = math.sqrt(max(middle - half, 0.0))
        probes = min(max(math.ceil(major / max(minor, 1.0) - 0.5), 1), _MAX_PROBES)
        du, dv = 0.0, 0.0
        if probes > 1:
            if uu >= vv:
                du, dv = middle + half - vv, cross
            else:
                du, dv = cross, middle + half - uu
            norm = major / math.sqrt(du * du + dv * dv)
            du, dv = du * norm / (probes * columns), dv * norm / (probes * rows)
        width = _SHARPNESS * max(minor, major / probes)
        level = min(math.log2(width), float(last)) if width > 1.0 else 0.0
        coarse = int(level)
        blend = level - coarse
        red, green, blue = 0.0, 0.0, 0.0
        for k in range(probes):
            pu, pv = u + (k - 0.5 * (probes - 1)) * du, v + (k - 0.5 * (probes - 1)) * dv
            first = _bilinear(
                texels, levels[coarse, 0], levels[coarse, 1], levels[coarse, 2], decode, pu, pv
            )
            red, green, blue = red + first[0], green + first[1], blue + first[2]
            if blend > 0.0:
                n = coarse + 1
                second = _bilinear(texels, levels[n, 0], levels[n, 1], levels[n, 2], decode, pu, pv)
                red += blend * (second[0] - first[0])
                green += blend * (second[1] - first[1])
                blue += blend * (second[2] - first[2])
        out[0, p], out[1, p], out[2, p] = red / probes, green / probes, blue / probes
