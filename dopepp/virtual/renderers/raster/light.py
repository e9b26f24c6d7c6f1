"""How points reflect light: shadows, Lambert and GGX, dielectric or metal, light from everywhere.

Every function works on n points at once: their ``position``, camera frame, metres, ``normal``, unit
vectors towards the camera, and ``albedo``, linear RGB, have the shape (3, n), ``alpha``, the width
of GGX, has (n,); all are float32. π is left out of every term: a white diffuse surface under
intensity 1 has radiance 1.
"""

from __future__ import annotations

import math

import numpy as np

from dopepp.core.compiled import Array, Scalar, compiled
from dopepp.virtual.scene import Ambient, Light
from dopepp.virtual.triangles import open_share, scratch

# Plain literals would turn the arithmetic into float64.
_ZERO, _HALF, _ONE, _TWO, _FOUR = (np.float32(value) for value in (0, 0.5, 1, 2, 4))
_GRAZING = np.float32(1e-3)
_TINY = np.float32(1e-6)


def light_row(light: Light) -> Array:
    """Return a light's position and its linear RGB at one metre, for compiled code."""
    return np.array([*light.position, *(light.reach**2 * np.array(light.intensity))], np.float32)


def ambient_row(ambient: Ambient) -> Array:
    """Return the up direction and the light from above and below, for compiled code."""
    return np.array([*ambient.up, *ambient.above, *ambient.below], np.float32)


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

    ``light`` comes from :func:`light_row`; ``inverse_depth`` and ``P`` are its shadow map's. Before
    a point is looked up it is lifted along its normal, by ``lift`` metres per metre of distance
    from the light (from √2 texels on, the four texels around it lie behind it on its own plane,
    whatever the slope), and by its ``bulge``, metres, shape (n,): a smooth ball of few flat
    triangles would shadow itself where its normals still face the light. ``lit`` has the shape
    (n,).
    """
    u, v, inverse = scratch("places", position.shape, np.float32)
    _place(position, normal, bulge, light, P, np.float32(lift), u, v, inverse)
    _compare(u, v, inverse, inverse_depth, lit)


@compiled(fastmath=True)
def reflect_ambient(
    position: Array, normal: Array, albedo: Array, alpha: Array, opened: Array, ambient: Array,
    metallic: float, radiance: Array,
) -> None:  # fmt: skip
    """Set the radiance to the reflected ambient light.

    A dielectric scatters the hemisphere around its normal; the little gloss on top is left out. A
    metal mirrors the hemisphere's colour in the reflected direction, the sharper the smoother it
    is, and tints it with its albedo. ``opened``, of shape (n,), is the share of the ambient light
    that reaches each point, ``ambient`` comes from :func:`ambient_row`, ``metallic`` is 1 for
    metals; ``radiance``, linear RGB of shape (3, n), is overwritten.
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
            radiance[c, p] = opened[p] * albedo[c, p] * light


@compiled(fastmath=True)
def reflect_light(
    position: Array, normal: Array, albedo: Array, alpha: Array, lit: Array, light: Array,
    specular: float, metallic: float, radiance: Array,
) -> None:  # fmt: skip
    """Add one point light: Lambert, and GGX with Smith's visibility and Schlick's Fresnel factor.

    ``lit``, of shape (n,), is the share of the light that reaches each point, ``light`` comes from
    :func:`light_row`, ``specular`` is the reflectance of the dielectric part at normal incidence,
    ``metallic`` 1 for a metal, whose reflectance is its albedo; ``radiance``, linear RGB of shape
    (3, n), is updated in place.
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
        lit[p] = open_share(u[p], v[p], inverse[p], inverse_depth) if inverse[p] > _ZERO else _ZERO
