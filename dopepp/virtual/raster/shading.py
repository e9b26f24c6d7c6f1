"""Shading: the light that an object's visible fragments send to the camera.

The steps follow one another over all fragments of an object: what they are (``fragments``), their
colour (``texture``, ``noise``), their normals (``grooves``), the sky above them (``occlusion``),
and each light (``lit``, ``reflectance``). To add a material effect, write one more such pass over
arrays and call it here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from dopepp.compiled import Array
from dopepp.virtual.raster.fragments import Fragments, gather_fragments
from dopepp.virtual.raster.grooves import tilt_normals
from dopepp.virtual.raster.lit import lit_shares
from dopepp.virtual.raster.noise import NOISE, tint_albedo
from dopepp.virtual.raster.occlusion import look_up_sky
from dopepp.virtual.raster.picture import add_colour
from dopepp.virtual.raster.projection import Projected
from dopepp.virtual.raster.reflectance import reflect_ambient, reflect_light
from dopepp.virtual.raster.scratch import scratch
from dopepp.virtual.raster.shadow import ShadowMap
from dopepp.virtual.raster.texture import sample_texture
from dopepp.virtual.raster.tone import CODE_STEPS, SRGB_TO_LINEAR, TONE_CURVE, TONE_LIMIT
from dopepp.virtual.scene import Scene, SceneObject

SHARPEST: Final = 0.002
"""Smallest width of a highlight: one under a point light would be narrower than any pixel."""

LIFT_TEXELS: Final = 1.5
"""Lift of a point before it is looked up in a shadow map; √2 keeps a plane from shadowing itself,
the rest is for rounding."""


def ambient_row(scene: Scene) -> Array:
    """Return the up direction and the light from above and below, for compiled code."""
    return np.array([*scene.ambient.up, *scene.ambient.above, *scene.ambient.below], np.float32)


def shade_object(
    item: SceneObject,
    seen: Projected,
    scene: Scene,
    lights: Sequence[tuple[Array, ShadowMap]],
    window: tuple[int, int, int, int],
    origin: tuple[int, int],
    ids: Array,
    inverse_depth: Array,
    first_id: int,
    colour: Array,
) -> None:
    """Add one object's light to the colour of the pixels that show it.

    Args:
        item: The object.
        seen: Its projected vertices.
        scene: Its camera and ambient light.
        lights: As of :func:`~dopepp.virtual.raster.shadow.shadow_maps`.
        window: Pixels to visit as (left, top, right, bottom) of the buffer, right/bottom excluded.
        origin: Image pixel (x, y) of the buffer's first element.
        ids: Triangle ids per sample, shape (height, width, S).
        inverse_depth: 1/m per sample, the same shape.
        first_id: Id of the object's first triangle.
        colour: Sum of sRGB values per pixel, float32 (height, width, 3), updated in place.
    """
    surface, material = item.surface, item.material
    rotation = np.ascontiguousarray(item.T_cam_obj[:3, :3], np.float64)
    fragments = gather_fragments(
        window, origin, ids, inverse_depth, first_id, surface.patches, seen.hom,
        surface.vertices, surface.faces, surface.normals, rotation, np.linalg.inv(scene.K),
    )  # fmt: skip
    count = len(fragments.pixel)
    if count == 0:
        return
    albedo = _albedo(item, seen, scene, fragments)
    alpha = scratch("alpha", (count,), np.float32)
    alpha.fill(max(material.roughness**2, SHARPEST))
    if material.grooves is not None:
        _cut_grooves(item, scene, fragments, alpha)
    sky, lit = scratch("sky", (count,), np.float32), scratch("lit", (count,), np.float32)
    radiance = scratch("radiance", (3, count), np.float32)
    look_up_sky(
        fragments.face, fragments.share, surface.sky.steps, surface.sky.firsts,
        surface.sky.values, sky,
    )  # fmt: skip
    position, normal = fragments.position, fragments.normal
    reflect_ambient(
        position, normal, albedo, alpha, sky, ambient_row(scene), material.metallic, radiance
    )
    for light, shadow in lights:
        lit_shares(
            position, normal, fragments.bulge, light, shadow.inverse_depth, shadow.P,
            LIFT_TEXELS * shadow.texel, lit,
        )  # fmt: skip
        reflect_light(
            position, normal, albedo, alpha, lit, light, material.specular, material.metallic,
            radiance,
        )  # fmt: skip
    add_colour(
        fragments.pixel, fragments.weight, radiance, TONE_CURVE, TONE_LIMIT, CODE_STEPS,
        colour.reshape(-1, 3),
    )  # fmt: skip


def _albedo(item: SceneObject, seen: Projected, scene: Scene, fragments: Fragments) -> Array:
    """Return the fragments' albedo: the texture times the material's colour, and its noise."""
    surface, material = item.surface, item.material
    albedo = scratch("albedo", (3, len(fragments.pixel)), np.float32)
    colour = np.array(material.colour, np.float32)[:, None]
    if surface.texture is None:
        albedo[:] = colour
    else:
        sample_texture(
            fragments.face, fragments.share, fragments.x, fragments.y, seen.hom, surface.faces,
            surface.uv, surface.texture.texels, surface.texture.levels, SRGB_TO_LINEAR, albedo,
        )  # fmt: skip
        albedo *= colour
    if material.noise > 0.0:
        tint_albedo(
            NOISE, fragments.position, item.T_cam_obj, float(scene.K[0, 0]), material.noise,
            material.noise_pitch, albedo,
        )  # fmt: skip
    return albedo


def _cut_grooves(item: SceneObject, scene: Scene, fragments: Fragments, alpha: Array) -> None:
    """Tilt the fragments' normals along the material's grooves, or widen their highlights."""
    grooves = item.material.grooves
    assert grooves is not None
    axis = item.T_cam_obj[:3, :3] @ np.array(grooves.axis, np.float64)
    tilt_normals(
        NOISE, fragments.position, axis, float(axis @ item.T_cam_obj[:3, 3]),
        np.array([scene.K[0, 0], scene.K[1, 1]]), grooves.pitch, grooves.slope,
        grooves.irregularity, fragments.normal, alpha,
    )  # fmt: skip
