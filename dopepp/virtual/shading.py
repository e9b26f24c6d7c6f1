"""Compiled shading: the colour of every visible triangle in every pixel it covers.

Lambert and GGX reflection, a hemisphere of ambient light, point lights of which the first casts
shadows, bilinear textures and a little noise.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dopepp.virtual.compiled import Array, compiled
from dopepp.virtual.visibility import NUM_COLOUR_SAMPLES

_codes = np.arange(256) / 255.0
SRGB_TO_LINEAR: NDArray[np.float32] = np.where(
    _codes <= 0.04045, _codes / 12.92, ((_codes + 0.055) / 1.055) ** 2.4
).astype(np.float32)
TONE_STEPS = 4096
"""Steps of the tone curve per unit of radiance."""

TONE_LIMIT = 4.0
"""Radiance at which the tone curve ends, white to 1/1000."""

_SHOULDER = 0.5
_radiance = np.arange(int(TONE_LIMIT) * TONE_STEPS + 1) / TONE_STEPS
# Linear up to the shoulder; above, it bends smoothly towards 1, as a camera's curve does, so that
# bright white parts keep their shading.
_exposed = np.where(
    _radiance <= _SHOULDER,
    _radiance,
    1 - (1 - _SHOULDER) * np.exp((_SHOULDER - _radiance) / (1 - _SHOULDER)),
)
TONE_CURVE: NDArray[np.float32] = (
    255 * np.where(_exposed <= 0.0031308, 12.92 * _exposed, 1.055 * _exposed ** (1 / 2.4) - 0.055)
).astype(np.float32)
"""Radiance in steps of 1/4096 to an sRGB value of 0–255."""


@compiled(fastmath=True, inline="always")
def _lattice(x: int, y: int, z: int) -> float:
    """Hash a lattice point to [0, 1): three odd multipliers and one xor-shift round."""
    h = (x * 374761393 + y * 668265263 + z * 2147483647) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return float((h ^ (h >> 16)) & 0xFFFF) / 65536.0


@compiled(fastmath=True)
def _value_noise(x: float, y: float, z: float) -> float:
    """Trilinear value noise in [-1, 1] with a lattice pitch of 1."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    x, y, z = x - fx, y - fy, z - fz
    total = 0.0
    for k in range(8):
        i, j, m = k & 1, (k >> 1) & 1, k >> 2
        weight = (x if i else 1 - x) * (y if j else 1 - y) * (z if m else 1 - z)
        total += weight * _lattice(ix + i, iy + j, iz + m)
    return 2.0 * total - 1.0


@compiled(fastmath=True)
def _lit_share(position: Array, light_map: Array, K_light: Array, T_light_cam: Array) -> float:
    """Return the share of a camera-frame point's shadow-map neighbourhood that sees the light."""
    x, y, z = position
    lz = T_light_cam[2, 0] * x + T_light_cam[2, 1] * y + T_light_cam[2, 2] * z + T_light_cam[2, 3]
    if lz <= 0.0:
        return 1.0
    lx = T_light_cam[0, 0] * x + T_light_cam[0, 1] * y + T_light_cam[0, 2] * z + T_light_cam[0, 3]
    ly = T_light_cam[1, 0] * x + T_light_cam[1, 1] * y + T_light_cam[1, 2] * z + T_light_cam[1, 3]
    u = K_light[0, 0] * lx / lz + K_light[0, 2]
    v = K_light[1, 1] * ly / lz + K_light[1, 2]
    size = light_map.shape[0]
    if not (0.0 <= u < size - 1 and 0.0 <= v < size - 1):
        return 1.0
    i, j = int(u), int(v)
    u, v = u - i, v - j
    inverse = 1.0 / lz
    # Percentage-closer filtering: the four comparisons are interpolated, not the depths.
    lit = 0.0
    for k in range(4):
        di, dj = k & 1, k >> 1
        if light_map[j + dj, i + di, 0] <= inverse:
            lit += (u if di else 1 - u) * (v if dj else 1 - v)
    return lit


@compiled(fastmath=True, inline="always")
def _reflect(
    n: Array, v: Array, light: Array, albedo: Array, roughness: float, specular: float, out: Array
) -> None:
    """Add one light's Lambert and GGX terms: Smith visibility and Schlick's Fresnel factor."""
    n_l = n[0] * light[0] + n[1] * light[1] + n[2] * light[2]
    if n_l <= 0.0:
        return
    n_v = max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], 1e-3)
    hx, hy, hz = light[0] + v[0], light[1] + v[1], light[2] + v[2]
    norm = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz + 1e-12)
    n_h = max((n[0] * hx + n[1] * hy + n[2] * hz) * norm, 0.0)
    v_h = max((v[0] * hx + v[1] * hy + v[2] * hz) * norm, 0.0)
    alpha2 = roughness**4
    d = n_h * n_h * (alpha2 - 1.0) + 1.0
    k = 0.5 * roughness * roughness
    smith = 4.0 * (n_l * (1 - k) + k) * (n_v * (1 - k) + k)
    grazing = 1.0 - v_h
    grazing2 = grazing * grazing
    fresnel = specular + (1.0 - specular) * grazing2 * grazing2 * grazing
    # π is left out of both terms: a white diffuse surface under intensity 1 has radiance 1.
    glint = fresnel * alpha2 / (d * d * smith)
    for c in range(3):
        out[c] += light[3 + c] * n_l * (albedo[c] * (1.0 - fresnel) + glint)


@compiled(fastmath=True)
def _sample_texture(texture: Array, decode: Array, u: float, v: float, out: Array) -> None:
    """Look a repeating texture up bilinearly in linear light; v points up, row 0 is the top."""
    rows, columns = texture.shape[0], texture.shape[1]
    x = (u - math.floor(u)) * columns - 0.5
    y = (1.0 - (v - math.floor(v))) * rows - 0.5
    i, j = math.floor(x), math.floor(y)
    x, y = x - i, y - j
    i0, i1 = i % columns, (i + 1) % columns
    j0, j1 = j % rows, (j + 1) % rows
    for c in range(3):
        top = decode[texture[j0, i0, c]] * (1 - x) + decode[texture[j0, i1, c]] * x
        bottom = decode[texture[j1, i0, c]] * (1 - x) + decode[texture[j1, i1, c]] * x
        out[c] = top * (1 - y) + bottom * y


@compiled(fastmath=True)
def shade(
    window: tuple[int, int, int, int],
    origin: tuple[int, int],
    ids: Array,
    first_id: int,
    vertices: Array,
    cam: Array,
    hom: Array,
    faces: Array,
    normals: Array,
    uv: Array,
    texture: Array,
    rotation: Array,
    material: Array,
    lights: Array,
    ambient: Array,
    light_map: Array,
    K_light: Array,
    T_light_cam: Array,
    shadow_bias: float,
    samples: Array,
    decode: Array,
    tone_curve: Array,
    colour: Array,
) -> None:
    """Add one object's light to the window's colour, weighted by the samples it covers.

    Each triangle is shaded once per pixel, at the mean of the samples it covers there (centroid
    sampling), so the cost follows pixels, not samples. Light is encoded to sRGB before samples
    are averaged, so a highlight's edge stays smooth.

    Args:
        window: Pixels to visit as (left, top, right, bottom) of the buffer, right/bottom excluded.
        origin: Image pixel (x, y) of the buffer's first element.
        ids: Triangle ids per sample, shape (height, width, S).
        first_id: Id of this object's first triangle.
        vertices: Object frame, metres; cam and hom: the same as ``project_vertices`` gave them.
        cam: Camera frame, metres.
        hom: Homogeneous pixels.
        faces: Vertex indices, shape (F, 3).
        normals: Object-frame normal of every corner, shape (F, 3, 3), float32.
        uv: Texture coordinates per vertex; shape (0, 2) without a texture.
        texture: RGB uint8 (any, unread, without uv).
        rotation: Object to camera, (3, 3).
        material: r, g, b (linear albedo or texture gain), roughness, specular, noise amplitude,
            noise frequency in 1/m.
        lights: One row a light: camera-frame position (3), linear RGB (3), reference distance
            at which RGB holds. The first one casts the shadow.
        ambient: Up direction (3), linear RGB from above (3) and from below (3).
        light_map: Inverse depth as the first light sees it, shape (N, N, 1).
        K_light: Pinhole matrix of the shadow map.
        T_light_cam: Camera frame to the first light's frame.
        shadow_bias: Metres by which a point is lifted along its normal before the shadow test.
        samples: Sample offsets, shape (S, 2).
        decode: :data:`SRGB_TO_LINEAR`.
        tone_curve: :data:`TONE_CURVE`.
        colour: Sum of sRGB values per pixel, float32 (height, width, 3), updated in place.
    """
    last_id = first_id + faces.shape[0]
    textured = uv.shape[0] > 0
    n, view, lit_point = np.empty(3), np.empty(3), np.empty(3)
    light = np.empty(6)
    albedo, radiance = np.empty(3), np.empty(3)
    for j in range(window[1], window[3]):
        for i in range(window[0], window[2]):
            for s in range(NUM_COLOUR_SAMPLES):
                face = ids[j, i, s]
                if face < first_id or face >= last_id:
                    continue
                count, dx, dy = 0, 0.0, 0.0
                for q in range(NUM_COLOUR_SAMPLES):
                    if ids[j, i, q] == face:
                        if q < s:
                            count = -1
                            break
                        count += 1
                        dx += samples[q, 0]
                        dy += samples[q, 1]
                if count < 0:
                    continue  # shaded with an earlier sample
                x = origin[0] + i + dx / count
                y = origin[1] + j + dy / count
                face -= first_id
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                ax, ay, aw = hom[a, 0], hom[a, 1], hom[a, 2]
                bx, by, bw = hom[b, 0], hom[b, 1], hom[b, 2]
                cx, cy, cw = hom[c, 0], hom[c, 1], hom[c, 2]
                k0 = (by * cw - bw * cy) * x + (bw * cx - bx * cw) * y + (bx * cy - by * cx)
                k1 = (cy * aw - cw * ay) * x + (cw * ax - cx * aw) * y + (cx * ay - cy * ax)
                k2 = (ay * bw - aw * by) * x + (aw * bx - ax * bw) * y + (ax * by - ay * bx)
                total = k0 + k1 + k2
                # All edge functions carry the determinant's sign: positive on a back face.
                side = -1.0 if total > 0.0 else 1.0
                k0, k1, k2 = k0 / total, k1 / total, k2 / total
                for r in range(3):
                    lit_point[r] = k0 * cam[a, r] + k1 * cam[b, r] + k2 * cam[c, r]
                o0 = k0 * normals[face, 0, 0] + k1 * normals[face, 1, 0] + k2 * normals[face, 2, 0]
                o1 = k0 * normals[face, 0, 1] + k1 * normals[face, 1, 1] + k2 * normals[face, 2, 1]
                o2 = k0 * normals[face, 0, 2] + k1 * normals[face, 1, 2] + k2 * normals[face, 2, 2]
                norm = side / math.sqrt(o0 * o0 + o1 * o1 + o2 * o2 + 1e-20)
                for r in range(3):
                    n[r] = norm * (rotation[r, 0] * o0 + rotation[r, 1] * o1 + rotation[r, 2] * o2)
                px, py, pz = lit_point[0], lit_point[1], lit_point[2]
                norm = -1.0 / math.sqrt(px * px + py * py + pz * pz)
                view[0], view[1], view[2] = px * norm, py * norm, pz * norm
                if textured:
                    u = k0 * uv[a, 0] + k1 * uv[b, 0] + k2 * uv[c, 0]
                    v = k0 * uv[a, 1] + k1 * uv[b, 1] + k2 * uv[c, 1]
                    _sample_texture(texture, decode, u, v, albedo)
                else:
                    albedo[:] = 1.0
                tint = 1.0
                if material[5] > 0.0:
                    tint += material[5] * _value_noise(
                        material[6]
                        * (k0 * vertices[a, 0] + k1 * vertices[b, 0] + k2 * vertices[c, 0]),
                        material[6]
                        * (k0 * vertices[a, 1] + k1 * vertices[b, 1] + k2 * vertices[c, 1]),
                        material[6]
                        * (k0 * vertices[a, 2] + k1 * vertices[b, 2] + k2 * vertices[c, 2]),
                    )
                above = 0.5 + 0.5 * (n[0] * ambient[0] + n[1] * ambient[1] + n[2] * ambient[2])
                for r in range(3):
                    albedo[r] *= material[r] * tint
                    radiance[r] = albedo[r] * (
                        above * ambient[3 + r] + (1.0 - above) * ambient[6 + r]
                    )
                for k in range(lights.shape[0]):
                    lx, ly, lz = lights[k, 0] - px, lights[k, 1] - py, lights[k, 2] - pz
                    square = lx * lx + ly * ly + lz * lz
                    norm = 1.0 / math.sqrt(square)
                    light[0], light[1], light[2] = lx * norm, ly * norm, lz * norm
                    share = lights[k, 6] * lights[k, 6] / square
                    facing = n[0] * light[0] + n[1] * light[1] + n[2] * light[2]
                    if facing <= 0.0:
                        continue
                    if k == 0:
                        for r in range(3):
                            lit_point[r] += shadow_bias * n[r]
                        share *= _lit_share(lit_point, light_map, K_light, T_light_cam)
                        if share == 0.0:
                            continue
                    for r in range(3):
                        light[3 + r] = share * lights[k, 3 + r]
                    _reflect(n, view, light, albedo, material[3], material[4], radiance)
                for r in range(3):
                    step = int(min(radiance[r], TONE_LIMIT) * TONE_STEPS + 0.5)
                    colour[j, i, r] += count * tone_curve[step]
