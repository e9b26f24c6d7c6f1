"""Shading: the light that an object's visible fragments send to the camera.

Each pass works on all fragments of an object: colour, grooves, ambient occlusion, and each light
with its shadow map. Arrays are float32. π is left out of every term: a white diffuse surface under
intensity 1 has radiance 1.

Grooves (layer lines of a print, brushed metal) are a sine of the distance along an axis, mixed with
noise. Averaged over a pixel of w grooves, a sine keeps sinc(w) of its amplitude. The lost slope
variance is added to the roughness (Olano and Baker, "LEAN mapping", 2010), so grooves never alias.

To add a material effect, write a pass and call it in :func:`shade_object`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from dopepp.core.compiled import Array, Scalar, compiled
from dopepp.virtual.renderers.raster.fragments import Fragments, gather_fragments
from dopepp.virtual.renderers.raster.visibility import (
    Projection,
    Samples,
    ShadowMap,
    ambient_row,
    panel_rows,
)
from dopepp.virtual.scene import NOISE_LIMITS, Scene, SceneObject
from dopepp.virtual.sensor import CODE_STEPS, SRGB_TO_LINEAR, TONE_CURVE, TONE_LIMIT
from dopepp.virtual.surface.occlusion import look_up_sky
from dopepp.virtual.surface.texture import sample_texture
from dopepp.virtual.triangles import scratch

# Plain literals would turn the arithmetic into float64.
_ZERO, _HALF, _ONE, _TWO, _FOUR = (np.float32(value) for value in (0, 0.5, 1, 2, 4))
_GRAZING, _TINY = np.float32(1e-3), np.float32(1e-6)

_SIDE: Final = 32
_MASK: Final = _SIDE - 1
# 32³ values of one byte stay in the processor's first cache; the seed only fixes the pattern.
_NOISE: Final = np.random.default_rng(0).integers(-127, 128, (_SIDE, _SIDE, _SIDE)).astype(np.int8)
"""Random values on a lattice that repeats every 32 steps, in units of 1/127."""


def shade_object(
    item: SceneObject,
    projection: Projection,
    scene: Scene,
    lights: Sequence[ShadowMap],
    samples: Samples,
    first_id: int,
    colour: Array,
) -> None:
    """Add an object's samples to ``colour``, the sum of sRGB values per pixel (height, width, 3).

    ``first_id`` is the id of the object's first triangle in the samples.
    """
    fragments = gather_fragments(item, projection, scene, samples, first_id)
    if fragments is None:
        return
    material, sky, count = item.material, item.surface.sky, len(fragments.pixel)
    _set_albedo(item, projection, scene, fragments)
    # A highlight under a point light may be narrower than any pixel.
    fragments.alpha.fill(max(material.roughness**2, 0.002))
    if (grooves := material.grooves) is not None:
        axis = item.T_cam_obj[:3, :3] @ np.array(grooves.axis, np.float64)
        origin, focal = float(axis @ item.T_cam_obj[:3, 3]), scene.K.diagonal()[:2]
        profile = np.array([grooves.pitch, grooves.slope, grooves.irregularity], np.float64)
        _tilt_normals(_NOISE, fragments, axis, origin, focal, profile)
    opened = scratch("sky", (count,), np.float32)
    radiance = scratch("radiance", (3, count), np.float32)
    look_up_sky(fragments.face, fragments.share, sky.steps, sky.firsts, sky.values, opened)
    ambient = ambient_row(scene.ambient)
    reflect_ambient(fragments, opened, ambient, material.metallic, radiance)
    if scene.ambient.panels:
        reflect_panels(fragments, opened, panel_rows(scene.ambient), material.metallic, radiance)
    for shadow in lights:
        lit = shadow.lit_shares(fragments.position, fragments.normal, fragments.bulge)
        specular, metallic = material.specular, material.metallic
        reflect_light(fragments, lit, shadow.light, specular, metallic, radiance)
    _add_colour(fragments.pixel, fragments.weight, radiance, TONE_CURVE, colour.reshape(-1, 3))


def _set_albedo(
    item: SceneObject, projection: Projection, scene: Scene, fragments: Fragments
) -> None:
    """Set the fragments' albedo to the surface's colour times the material's colour and noise."""
    surface, material, albedo = item.surface, item.material, fragments.albedo
    face, share = fragments.face, fragments.share
    if surface.texture is not None:
        texture = (surface.texture.texels, surface.texture.levels, SRGB_TO_LINEAR)
        points = (face, share, fragments.x, fragments.y)
        sample_texture(points, projection.hom, surface.faces, surface.uv, texture, albedo)
    elif len(surface.colours):
        _blend_colours(face, share, surface.faces, surface.colours, albedo)
    else:
        albedo.fill(1.0)
    albedo *= np.array(material.colour, np.float32)[:, None]
    if material.noise > 0.0:
        amplitude, pitch, focal = material.noise, material.noise_pitch, float(scene.K[0, 0])
        _tint_albedo(_NOISE, fragments, item.T_cam_obj, focal, amplitude, pitch)


@compiled(fastmath=True)
def _blend_colours(face: Array, share: Array, faces: Array, colours: Array, albedo: Array) -> None:
    """Set the albedo to the interpolated colours of the triangle's corners, linear RGB."""
    for p in range(face.shape[0]):
        # A triangle seen from behind is its number's bitwise complement.
        corners = faces[face[p] if face[p] >= 0 else ~face[p]]
        for c in range(3):
            albedo[c, p] = (
                share[0, p] * colours[corners[0], c]
                + share[1, p] * colours[corners[1], c]
                + share[2, p] * colours[corners[2], c]
            )


@compiled(fastmath=True)
def _tint_albedo(
    noise: Array, fragments: Fragments, T_cam_obj: Array, focal: float, height: float, pitch: float
) -> None:
    """Multiply the albedo by 1 + ``height`` times noise with a lattice of ``pitch`` metres."""
    position, albedo = fragments.position, fragments.albedo
    least, greatest = NOISE_LIMITS
    for p in range(position.shape[1]):
        # The shortest wave spans two lattice steps and needs two pixels.
        fade = 2.0 - position[2, p] / (focal * pitch)
        if fade <= 0.0:
            continue
        x = position[0, p] - T_cam_obj[0, 3]
        y = position[1, p] - T_cam_obj[1, 3]
        z = position[2, p] - T_cam_obj[2, 3]
        tint = 1.0 + height * min(fade, 1.0) * _value_noise(
            noise,
            (T_cam_obj[0, 0] * x + T_cam_obj[1, 0] * y + T_cam_obj[2, 0] * z) / pitch,
            (T_cam_obj[0, 1] * x + T_cam_obj[1, 1] * y + T_cam_obj[2, 1] * z) / pitch,
            (T_cam_obj[0, 2] * x + T_cam_obj[1, 2] * y + T_cam_obj[2, 2] * z) / pitch,
        )
        tint = min(max(tint, least), greatest)
        for c in range(3):
            albedo[c, p] *= tint


@compiled(fastmath=True)
def _tilt_normals(
    noise: Array, fragments: Fragments, axis: Array, origin: float, focal: Array, profile: Array
) -> None:
    """Tilt the normals of a grooved surface, or widen alpha where grooves are finer than pixels.

    ``axis`` is the unit vector across the grooves, camera frame; ``origin`` is the coordinate of
    the object's origin along it, metres; ``profile`` is pitch (metres), slope and irregularity.
    """
    position, normal, alpha = fragments.position, fragments.normal, fragments.alpha
    ax, ay, az = axis
    pitch, slope, irregularity = profile[0], profile[1], profile[2]
    for p in range(position.shape[1]):
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        px, py, pz = position[0, p], position[1, p], position[2, p]
        along = ax * nx + ay * ny + az * nz
        # The axis within the surface; its length is the sine between axis and normal.
        tx, ty, tz = ax - along * nx, ay - along * ny, az - along * nz
        # One pixel to the right moves the point by z (r_x − r (n·r_x)/(n·r)), r = P/z.
        facing = min(nx * px + ny * py + nz * pz, -1e-3 * pz) / pz
        shift = (ax * px + ay * py + az * pz) / (pz * facing)
        right = pz / focal[0] * (ax - shift * nx)
        down = pz / focal[1] * (ay - shift * ny)
        kept = _kept_share(math.sqrt(right * right + down * down) / pitch)
        if kept > 0.0:
            phase = (ax * px + ay * py + az * pz - origin) / pitch
            wave = (1.0 - irregularity) * math.sin(2.0 * math.pi * phase)
            if irregularity > 0.0:
                wave += irregularity * _streak_noise(noise, 2.0 * phase)
            tilt = slope * kept * wave
            nx, ny, nz = nx - tilt * tx, ny - tilt * ty, nz - tilt * tz
            norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
            normal[0, p], normal[1, p], normal[2, p] = norm * nx, norm * ny, norm * nz
        # A sine of amplitude s has the slope variance s²/2 along one axis, so s²/4 on average
        # over both, and a Beckmann or GGX lobe of width α has α²/2.
        lost = slope * slope * (tx * tx + ty * ty + tz * tz) * (1.0 - kept * kept)
        alpha[p] = min(math.sqrt(alpha[p] * alpha[p] + 0.5 * lost), 1.0)


@compiled(fastmath=True)
def _kept_share(grooves_per_px: float) -> float:
    """Return the share of a sine's amplitude that survives averaging over a pixel."""
    if grooves_per_px >= 1.0:
        return 0.0
    angle = math.pi * grooves_per_px
    return math.sin(angle) / angle if angle > 1e-3 else 1.0


@compiled(fastmath=True)
def _value_noise(noise: Array, x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Return trilinear noise in [-1, 1] of lattice pitch 1 (``noise`` is :data:`_NOISE`)."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    x, y, z = x - fx, y - fy, z - fz
    i0, j0, m0 = int(fx) & _MASK, int(fy) & _MASK, int(fz) & _MASK
    i1, j1, m1 = (i0 + 1) & _MASK, (j0 + 1) & _MASK, (m0 + 1) & _MASK
    a = noise[m0, j0, i0] * (1 - x) + noise[m0, j0, i1] * x
    b = noise[m0, j1, i0] * (1 - x) + noise[m0, j1, i1] * x
    c = noise[m1, j0, i0] * (1 - x) + noise[m1, j0, i1] * x
    d = noise[m1, j1, i0] * (1 - x) + noise[m1, j1, i1] * x
    return ((a * (1 - y) + b * y) * (1 - z) + (c * (1 - y) + d * y) * z) / 127.0


@compiled(fastmath=True)
def _streak_noise(noise: Array, x: Scalar) -> Scalar:
    """Return linear noise in [-1, 1] of pitch 1 along a line; it repeats after 32³ steps."""
    fx = math.floor(x)
    share, i = x - fx, int(fx)
    j = i + 1
    a = noise[(i >> 10) & _MASK, (i >> 5) & _MASK, i & _MASK]
    b = noise[(j >> 10) & _MASK, (j >> 5) & _MASK, j & _MASK]
    return (a * (1 - share) + b * share) / 127.0


@compiled(fastmath=True)
def reflect_ambient(
    fragments: Fragments, opened: Array, ambient: Array, metallic: float, radiance: Array
) -> None:
    """Set ``radiance`` to the ambient light that the fragments reflect to the camera.

    A dielectric scatters the hemisphere around its normal; its weak gloss is ignored. A metal
    mirrors the hemisphere's colour in the reflected direction, tinted with its albedo; a smoother
    metal mirrors more sharply.
    ``opened`` is the share of the light that reaches each point.
    """
    position, normal = fragments.position, fragments.normal
    albedo, alpha = fragments.albedo, fragments.alpha
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
            # A metal mirrors the horizon as an edge as wide as the GGX lobe.
            sharpness = 1.0 / (0.1 + 0.9 * alpha[p])
            mirrored = min(max(0.5 + 0.5 * sharpness * mirror, 0.0), 1.0)
        for c in range(3):
            scattered = above * ambient[3 + c] + (1.0 - above) * ambient[6 + c]
            gloss = mirrored * ambient[3 + c] + (1.0 - mirrored) * ambient[6 + c]
            light = (1.0 - metallic) * scattered + metallic * gloss
            radiance[c, p] = opened[p] * albedo[c, p] * light


@compiled(fastmath=True)
def reflect_panels(
    fragments: Fragments, opened: Array, panels: Array, metallic: float, radiance: Array
) -> None:
    """Add the light of distant panels: scattered by a dielectric, mirrored by a metal.

    A GGX lobe of width α spreads a mirror image by √2 α along both axes.
    ``opened`` is the share of the ambient light that reaches each point.
    """
    position, normal = fragments.position, fragments.normal
    albedo, alpha = fragments.albedo, fragments.alpha
    for p in range(position.shape[1]):
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        px, py, pz = position[0, p], position[1, p], position[2, p]
        inverse = 1.0 / math.sqrt(px * px + py * py + pz * pz)
        turn = -2.0 * (nx * px + ny * py + nz * pz) * inverse
        rx, ry, rz = px * inverse + turn * nx, py * inverse + turn * ny, pz * inverse + turn * nz
        spread = 2.0 * alpha[p] * alpha[p]
        for k in range(panels.shape[0]):
            panel = panels[k]
            width, length = panel[9], panel[10]
            facing = nx * panel[0] + ny * panel[1] + nz * panel[2]
            light = (1.0 - metallic) * 2.0 * width * length * max(facing, 0.0)
            if metallic > 0.0:
                front = 0.5 + 2.0 * (rx * panel[0] + ry * panel[1] + rz * panel[2])
                along = rx * panel[3] + ry * panel[4] + rz * panel[5]
                across = rx * panel[6] + ry * panel[7] + rz * panel[8]
                wide, long = width * width + spread, length * length + spread
                peak = width * length / math.sqrt(wide * long) * min(max(front, 0.0), 1.0)
                distance = across * across / wide + along * along / long
                light += metallic * peak * math.exp(-0.5 * distance)
            for c in range(3):
                radiance[c, p] += opened[p] * albedo[c, p] * light * panel[11 + c]


@compiled(fastmath=True)
def reflect_light(
    fragments: Fragments, lit: Array, light: Array, specular: float, metal: float, radiance: Array
) -> None:
    """Add the reflection of a point light: Lambert, and GGX with Smith's and Schlick's factors.

    ``lit`` is the share of the light that reaches each point, and ``light`` a field of
    :class:`ShadowMap`. ``specular`` is a dielectric's reflectance at normal incidence; a metal's is
    its albedo. ``radiance`` (linear RGB) is increased in place.
    """
    position, normal = fragments.position, fragments.normal
    albedo, alpha = fragments.albedo, fragments.alpha
    base, metallic = np.float32(specular), np.float32(metal)
    matt = _ONE - metallic
    for p in range(position.shape[1]):
        px, py, pz = position[0, p], position[1, p], position[2, p]
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        lx, ly, lz = light[0] - px, light[1] - py, light[2] - pz
        square = lx * lx + ly * ly + lz * lz + _TINY
        norm = _ONE / math.sqrt(square)
        n_l = max((nx * lx + ny * ly + nz * lz) * norm, _ZERO)
        inverse_distance = _ONE / math.sqrt(px * px + py * py + pz * pz)
        n_v = max(-(nx * px + ny * py + nz * pz) * inverse_distance, _GRAZING)
        # |l + v|² = 2 + 2 l·v, and v·h = (1 + l·v)/|l + v|.
        l_v = -(lx * px + ly * py + lz * pz) * (norm * inverse_distance)
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
            upright = base + metallic * (albedo[c, p] - base)
            fresnel = upright + (_ONE - upright) * grazing5
            diffuse = matt * albedo[c, p] * (_ONE - fresnel)
            radiance[c, p] += strength * light[3 + c] * (diffuse + fresnel * lobe)


@compiled(fastmath=True)
def _add_colour(pixel: Array, weight: Array, radiance: Array, curve: Array, colour: Array) -> None:
    """Add the fragments' sRGB values, by ``weight``, to their pixels; ``curve`` is the tone curve.

    Light is encoded before samples are averaged, so a highlight's edge stays smooth.
    """
    for p in range(pixel.shape[0]):
        for c in range(3):
            step = int(min(max(radiance[c, p], 0.0), TONE_LIMIT) * CODE_STEPS + 0.5)
            colour[pixel[p], c] += weight[p] * curve[step]
