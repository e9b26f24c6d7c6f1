"""How a point reflects light: Lambert and GGX, dielectric or metal, and the light from everywhere.

π is left out of every term: a white diffuse surface under intensity 1 has radiance 1.
"""

from __future__ import annotations

import math

import numpy as np

from dopepp.compiled import Array, compiled

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
