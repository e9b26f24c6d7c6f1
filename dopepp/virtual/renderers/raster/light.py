"""How a point reflects light: Lambert and GGX, dielectric or metal, and the light from everywhere.

π is left out of every term: a white diffuse surface under intensity 1 has radiance 1.

Codes and light: sRGB decoding, and the camera's tone curve from radiance to sRGB.

Who is lit: points looked up in a shadow map, compiled, in float32.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dopepp.core.compiled import Array, Scalar, compiled
from dopepp.virtual.renderers.raster.visibility import scratch

_codes = np.arange(256) / 255.0
SRGB_TO_LINEAR: Final[NDArray[np.float32]] = np.where(
    _codes <= 0.04045, _codes / 12.92, ((_codes + 0.055) / 1.055) ** 2.4
).astype(np.float32)
"""sRGB code 0–255 to linear light in [0, 1]."""

CODE_STEPS: Final = 4096
"""Steps of the tables that encode light, per unit of light."""


def _encoded(linear: NDArray[np.float64]) -> NDArray[np.float32]:
    codes = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(255 * codes, np.float32)


LINEAR_TO_SRGB: Final = _encoded(np.arange(CODE_STEPS + 1) / CODE_STEPS)
"""Linear light in steps of 1/4096 to an sRGB value of 0–255, the inverse of SRGB_TO_LINEAR."""

TONE_LIMIT: Final = 4.0
"""Radiance at which the tone curve ends, white to 1/1000."""

_SHOULDER: Final = 0.5
_radiance = np.arange(int(TONE_LIMIT) * CODE_STEPS + 1) / CODE_STEPS
# Linear up to the shoulder; above, it bends smoothly towards 1, as a camera's curve does, so that
# bright white parts keep their shading.
TONE_CURVE: Final = _encoded(
    np.where(
        _radiance <= _SHOULDER,
        _radiance,
        1 - (1 - _SHOULDER) * np.exp((_SHOULDER - _radiance) / (1 - _SHOULDER)),
    )
)
"""Radiance in steps of 1/4096 to an sRGB value of 0–255."""


@compiled(fastmath=True)
def _open_share(u: Scalar, v: Scalar, inverse: Scalar, inverse_depth: Array) -> Scalar:
    """Compare a point with the four texels around it; 1 beside the map.

    Percentage-closer filtering: the comparisons are interpolated, not the depths.
    """
    rows, columns = inverse_depth.shape[0], inverse_depth.shape[1]
    if not (_ZERO <= u < np.float32(columns - 1) and _ZERO <= v < np.float32(rows - 1)):
        return _ONE
    i, j = np.int64(u), np.int64(v)
    u, v = u - np.float32(i), v - np.float32(j)
    a = _ONE if inverse_depth[j, i, 0] <= inverse else _ZERO
    b = _ONE if inverse_depth[j, i + 1, 0] <= inverse else _ZERO
    c = _ONE if inverse_depth[j + 1, i, 0] <= inverse else _ZERO
    d = _ONE if inverse_depth[j + 1, i + 1, 0] <= inverse else _ZERO
    top, bottom = a + u * (b - a), c + u * (d - c)
    return top + v * (bottom - top)


@compiled(fastmath=True)
def lit_share(x: Scalar, y: Scalar, z: Scalar, inverse_depth: Array, P: Array) -> Scalar:
    """Return the share of a point's neighbourhood in a shadow map that sees the light.

    Args:
        x: The point, like y and z; metres, float32.
        y: Idem.
        z: Idem.
        inverse_depth: The map, 1/m, shape (height, width, 1), float32.
        P: Projects the point into the map: homogeneous pixels, of which the third is the depth,
            shape (3, 4), float32.
    """
    depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    if depth <= _ZERO:
        return _ONE
    inverse = _ONE / depth
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) * inverse
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) * inverse
    return _open_share(u, v, inverse, inverse_depth)


def lit_shares(
    position: Array,
    normal: Array,
    bulge: Array,
    light: Array,
    inverse_depth: Array,
    P: Array,
    lift: float,
    lit: Array,
) -> None:
    """Write the share of a light's light that reaches each point; 0 where it faces away.

    Args:
        position: Points in the camera frame, metres, shape (3, n).
        normal: Unit normals, shape (3, n).
        bulge: Metres by which a point is lifted besides, shape (n,): a smooth ball of few flat
            triangles would shadow itself where its normals still face the light.
        light: The light's position in the camera frame, shape (>= 3,), float32.
        inverse_depth: The shadow map.
        P: Camera frame to the map, shape (3, 4), float32.
        lift: By which a point is lifted along its normal before it is looked up, metres per metre
            of distance from the light. From √2 texels on, the four texels around it lie behind it
            on its own plane, whatever the slope.
        lit: Result, shape (n,).
    """
    u, v, inverse = scratch("places", position.shape, np.float32)
    _place(position, normal, bulge, light, P, np.float32(lift), u, v, inverse)
    _compare(u, v, inverse, inverse_depth, lit)


@compiled(fastmath=True)
def _place(
    position: Array, normal: Array, bulge: Array, light: Array, P: Array, lift: Scalar, u: Array,
    v: Array, inverse: Array,
) -> None:  # fmt: skip
    """Project lifted points into the map: (u, v) and 1/depth, negative where they face away."""
    x0, y0, z0 = light[0], light[1], light[2]
    a, b, c, d = P[0, 0], P[0, 1], P[0, 2], P[0, 3]
    e, f, g, h = P[1, 0], P[1, 1], P[1, 2], P[1, 3]
    i, j, k, m = P[2, 0], P[2, 1], P[2, 2], P[2, 3]
    for p in range(position.shape[1]):
        x, y, z = position[0, p], position[1, p], position[2, p]
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        facing = nx * (x0 - x) + ny * (y0 - y) + nz * (z0 - z)
        up = bulge[p] + lift * (i * x + j * y + k * z + m)
        x, y, z = x + up * nx, y + up * ny, z + up * nz
        scale = _ONE / (i * x + j * y + k * z + m)
        u[p] = (a * x + b * y + c * z + d) * scale
        v[p] = (e * x + f * y + g * z + h) * scale
        inverse[p] = scale if facing > _ZERO else -_ONE


@compiled(fastmath=True)
def _compare(u: Array, v: Array, inverse: Array, inverse_depth: Array, lit: Array) -> None:
    """Compare projected points with the map."""
    for p in range(lit.shape[0]):
        lit[p] = _open_share(u[p], v[p], inverse[p], inverse_depth) if inverse[p] > _ZERO else _ZERO


# Plain literals would turn the arithmetic into float64.
_ZERO, _HALF, _ONE, _TWO, _FOUR = (np.float32(value) for value in (0, 0.5, 1, 2, 4))
_GRAZING = np.float32(1e-3)
_TINY = np.float32(1e-6)


@compiled(fastmath=True)
def reflect_ambient(
    position: Array,
    normal: Array,
    albedo: Array,
    alpha: Array,
    open_share: Array,
    ambient: Array,
    metallic: float,
    radiance: Array,
) -> None:
    """Set the radiance to the reflected ambient light.

    A dielectric scatters the hemisphere around its normal; the little gloss on top is left out. A
    metal mirrors the hemisphere's colour in the reflected direction, the sharper the smoother it
    is, and tints it with its albedo.

    Args:
        position: Points in the camera frame, metres, shape (3, n).
        normal: Unit normals towards the camera, shape (3, n).
        albedo: Linear RGB, shape (3, n).
        alpha: GGX width, shape (n,).
        open_share: Share of the ambient light that reaches each point, shape (n,).
        ambient: Up direction (3), linear RGB from above (3) and from below (3).
        metallic: 0 dielectric, 1 metal.
        radiance: Linear RGB, shape (3, n), overwritten.
    """
    ux, uy, uz = ambient[0], ambient[1], ambient[2]
    for p in range(position.shape[1]):
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        height = nx * ux + ny * uy + nz * uz
        above = 0.5 + 0.5 * height
        mirrored = above
        if metallic > 0.0:
            px, py, pz = position[0, p], position[1, p], position[2, p]
            length = math.sqrt(px * px + py * py + pz * pz)
            turn = -2.0 * (nx * px + ny * py + nz * pz) / length
            mirror = (ux * px + uy * py + uz * pz) / length + turn * height
            # A smooth metal shows the horizon as an edge as wide as its lobe.
            sharpness = 1.0 / (0.1 + 0.9 * alpha[p])
            mirrored = min(max(0.5 + 0.5 * sharpness * mirror, 0.0), 1.0)
        for c in range(3):
            scattered = above * ambient[3 + c] + (1.0 - above) * ambient[6 + c]
            gloss = mirrored * ambient[3 + c] + (1.0 - mirrored) * ambient[6 + c]
            light = (1.0 - metallic) * scattered + metallic * gloss
            radiance[c, p] = open_share[p] * albedo[c, p] * light


@compiled(fastmath=True)
def reflect_light(
    position: Array,
    normal: Array,
    albedo: Array,
    alpha: Array,
    lit: Array,
    light: Array,
    specular: float,
    metallic: float,
    radiance: Array,
) -> None:
    """Add one point light: Lambert, and GGX with Smith's visibility and Schlick's Fresnel factor.

    Args:
        position: Points in the camera frame, metres, shape (3, n).
        normal: Unit normals towards the camera, shape (3, n).
        albedo: Linear RGB, shape (3, n).
        alpha: GGX width, shape (n,).
        lit: Share of the light that reaches each point, shape (n,).
        light: Position (3) and linear RGB at one metre (3).
        specular: Reflectance of the dielectric part at normal incidence.
        metallic: 0 dielectric, 1 metal, whose reflectance is its albedo.
        radiance: Linear RGB, shape (3, n), updated in place.
    """
    base, metal = np.float32(specular), np.float32(metallic)
    matt = _ONE - metal
    for p in range(position.shape[1]):
        px, py, pz = position[0, p], position[1, p], position[2, p]
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        lx, ly, lz = light[0] - px, light[1] - py, light[2] - pz
        square = lx * lx + ly * ly + lz * lz + _TINY
        norm = _ONE / math.sqrt(square)
        n_l = max((nx * lx + ny * ly + nz * lz) * norm, _ZERO)
        away = _ONE / math.sqrt(px * px + py * py + pz * pz)
        n_v = max(-(nx * px + ny * py + nz * pz) * away, _GRAZING)
        # |l + v|² = 2 + 2 l·v, and v·h = (1 + l·v)/|l + v|.
        l_v = -(lx * px + ly * py + lz * pz) * (norm * away)
        half = _ONE / math.sqrt(_TWO + _TWO * l_v + _TINY)
        n_h = min((n_l + n_v) * half, _ONE)
        alpha2 = alpha[p] * alpha[p]
        d = n_h * n_h * (alpha2 - _ONE) + _ONE
        k = _HALF * alpha[p]
        smith = _FOUR * (n_l * (_ONE - k) + k) * (n_v * (_ONE - k) + k)
        lobe = alpha2 / (d * d * smith)
        grazing = _ONE - (_ONE + l_v) * half
        grazing2 = grazing * grazing
        grazing5 = grazing2 * grazing2 * grazing
        # No branch: a point that is not lit adds nothing, and the loop stays a vector loop.
        strength = lit[p] * n_l / square
        for c in range(3):
            upright = base + metal * (albedo[c, p] - base)
            fresnel = upright + (_ONE - upright) * grazing5
            diffuse = matt * albedo[c, p] * (_ONE - fresnel)
            radiance[c, p] += strength * light[3 + c] * (diffuse + fresnel * lobe)
