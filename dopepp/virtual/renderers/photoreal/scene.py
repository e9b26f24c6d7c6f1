"""A scene as Mitsuba takes it: meshes, reflectance, lamps and the sky.

Everything stands in the camera frame, as in the rest of the package. Light is matched to
``raster.shading``: a lamp is a sphere that gives a surface what the point light gives
it, and the sky is two hemispheres. What differs is what path tracing adds: soft shadows, light
from object to object, reflections of the lamps and the surroundings.

Grooves finer than a pixel only widen the highlight, and that is how all of them are drawn here: by
roughness. The albedo's variation is drawn on untextured surfaces.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Float32

from dopepp.geometry.camera import CameraMatrix, Transform, transform
from dopepp.geometry.rotation import Vector, rotation_to_z
from dopepp.parts.mesh import face_areas
from dopepp.virtual.scene import NOISE_LIMITS, Ambient, Light, Material, Scene, SceneObject
from dopepp.virtual.sensor import SRGB_TO_LINEAR
from dopepp.virtual.surface import Surface
from dopepp.virtual.surface.texture import Texture

Sphere = tuple[Vector, float]
"""Centre and radius, camera frame, metres."""

LAMP_SHARE: Final = 0.06
"""A lamp's radius over its distance: a bulb of 6 cm across at half a metre."""

_MAX_ALBEDO: Final = 0.95
_VERTEX_COLOUR: Final = "vertex_colour"
"""Nothing reflects all light; more would also keep paths alive without end."""

_SKY_ROWS: Final = 64
_NOISE_CELLS: Final = 64
"""Side of the repeating lattice of random albedos, cells."""


def make_shapes(mi: Any, scene: Scene) -> list[Any]:
    """Return one Mitsuba mesh per object, in the scene's order."""
    shapes = []
    for item in scene.objects:
        reflectance = mi.load_dict(_reflectance(mi, item, scene.K), parallel=False)
        shapes.append(_mesh(mi, item, reflectance))
    return shapes


def make_surroundings(mi: Any, scene: Scene, bounds: Sphere) -> dict[str, Any]:
    """Return the lamps and the sky, to be merged into Mitsuba's description of the scene."""
    entries: dict[str, Any] = {"sky": _sky(mi, scene.ambient)}
    for number, light in enumerate(scene.lights):
        radius = lamp_radius(light, scene, bounds)
        radiance = np.array(light.intensity) * (light.reach / radius) ** 2
        entries[f"lamp{number}"] = {
            "type": "sphere",
            "center": list(light.position),
            "radius": radius,
            "emitter": {"type": "area", "radiance": rgb(radiance)},
        }
    return entries


def bounding_sphere(scene: Scene) -> Sphere:
    """Return a sphere around all objects of a scene that has some."""
    points = np.concatenate(
        [transform(item.T_cam_obj, item.surface.hull) for item in scene.objects]
    )
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return middle, float(np.linalg.norm(points - middle, axis=1).max())


def lamp_radius(light: Light, scene: Scene, bounds: Sphere) -> float:
    """Return the radius of the sphere that stands for a point light, metres."""
    position = np.array(light.position)
    distance = float(np.linalg.norm(position - bounds[0]))
    room = [float(np.linalg.norm(position))]
    room += [
        float(np.linalg.norm(transform(item.T_cam_obj, item.surface.hull) - position, axis=1).min())
        for item in scene.objects
    ]
    if scene.plane is not None:
        room.append(float(np.array(scene.plane.normal) @ position) - scene.plane.offset)
    # It reaches at most half of the way to an object, the camera or the table.
    return max(min(LAMP_SHARE * distance, 0.5 * min(room)), 1e-3)


def rgb(values: Vector) -> dict[str, Any]:
    """Return a colour as Mitsuba takes it."""
    return {"type": "rgb", "value": [float(value) for value in values]}


def _mesh(mi: Any, item: SceneObject, reflectance: Any) -> Any:
    """Return a mesh whose triangles share no vertex, because normals break at creases."""
    surface, rotation = item.surface, item.T_cam_obj[:3, :3]
    corners = transform(item.T_cam_obj, surface.vertices)[surface.faces].reshape(-1, 3)
    properties = mi.Properties()
    properties["bsdf"] = reflectance
    mesh = mi.Mesh(
        item.label, len(corners), len(surface.faces), props=properties,
        has_vertex_normals=True, has_vertex_texcoords=True,
    )  # fmt: skip
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ravel(corners).astype(np.float32)
    normals = surface.normals.reshape(-1, 3) @ rotation.T
    parameters["vertex_normals"] = np.ravel(normals).astype(np.float32)
    parameters["vertex_texcoords"] = np.ravel(_corner_uv(surface)).astype(np.float32)
    parameters["faces"] = np.arange(len(corners), dtype=np.uint32)
    parameters.update()
    if len(surface.colours):
        albedo = surface.colours * np.asarray(item.material.colour, np.float32)
        values = np.clip(albedo, 0.0, _MAX_ALBEDO)[surface.faces]
        mesh.add_attribute(_VERTEX_COLOUR, 3, np.ravel(values).astype(np.float32))
    return mesh


def _corner_uv(surface: Surface) -> Float[np.ndarray, "corners 2"]:
    """Return texture coordinates, v down; without a texture, metres along the two flattest axes."""
    if len(surface.uv):
        uv = surface.uv[surface.faces].reshape(-1, 2)
        return np.asarray(np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1))
    corners = surface.vertices[surface.faces]
    facing = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axes = np.argsort(facing, axis=1, kind="stable")[:, None, :2]
    return np.asarray(np.take_along_axis(corners, np.sort(axes, axis=2), axis=2).reshape(-1, 2))


def _reflectance(mi: Any, item: SceneObject, K: CameraMatrix) -> dict[str, Any]:
    """Return the material: Lambert and GGX with a metallic workflow, on both sides."""
    material = item.material
    root = math.sqrt(min(max(material.specular, 1e-4), 0.9))
    return {
        "type": "twosided",
        "bsdf": {
            "type": "principled",
            "base_color": _colour(mi, item, K),
            "roughness": _roughness(material),
            "metallic": float(material.metallic),
            # Fresnel's reflectance at normal incidence, solved for the refractive index.
            "eta": (1 + root) / (1 - root),
        },
    }


def _roughness(material: Material) -> float:
    """Return GGX roughness (its square is α) widened by the slopes of the grooves."""
    variance = material.roughness**4
    if material.grooves is not None:
        # A sine of largest slope s has the slope variance s²/2 across the grooves and none along
        # them: s²/4 on average. GGX's α² stands for twice the variance.
        variance += material.grooves.slope**2 / 2
    return float(min(variance**0.25, 1.0))


def _colour(mi: Any, item: SceneObject, K: CameraMatrix) -> dict[str, Any]:
    """Return the albedo: constant, mottled, of the vertices, or a texture, linear RGB."""
    material, texture = item.material, item.surface.texture
    colour = np.asarray(material.colour, np.float32)
    if texture is not None:
        codes = texture.image(_texture_level(item.surface, texture, item.T_cam_obj, K))
        return _bitmap(mi, SRGB_TO_LINEAR[codes] * colour, np.eye(4))
    if len(item.surface.colours):
        return {"type": "mesh_attribute", "name": _VERTEX_COLOUR}
    if material.noise == 0.0:
        return rgb(np.clip(colour, 0.0, _MAX_ALBEDO))
    # Random from cell to cell, always the same: only the look of a rough surface.
    cells = np.random.default_rng(0).uniform(-1, 1, (_NOISE_CELLS, _NOISE_CELLS, 1))
    scale = 1.0 / (_NOISE_CELLS * material.noise_pitch)
    tint = np.clip(1 + material.noise * cells, *NOISE_LIMITS)
    texels = (colour * tint).astype(np.float32)
    return _bitmap(mi, texels, np.diag([scale, scale, 1.0, 1.0]))


def _bitmap(
    mi: Any, texels: Float32[np.ndarray, "rows columns 3"], to_uv: np.ndarray
) -> dict[str, Any]:
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.clip(texels, 0.0, _MAX_ALBEDO)),
        "raw": True,
        "to_uv": mi.ScalarTransform4f(to_uv),
    }


def _texture_level(
    surface: Surface, texture: Texture, T_cam_obj: Transform, K: CameraMatrix
) -> int:
    """Return the texture level whose texels are about half as large as the object's pixels."""
    depth = float(T_cam_obj[2, 3])
    a, b, c = surface.uv[surface.faces].transpose(1, 2, 0)
    along, across = b - a, c - a
    used = float(np.abs(along[0] * across[1] - along[1] * across[0]).sum() / 2)
    if used == 0.0 or depth <= 0.0:
        return 0
    texels = used * texture.levels[0, 1] * texture.levels[0, 2]
    pixels = face_areas(surface.vertices, surface.faces).sum() * K[0, 0] * K[1, 1] / depth**2
    level = math.floor(0.5 * math.log2(max(texels / pixels, 1.0))) - 1
    return min(max(level, 0), len(texture.levels) - 1)


def _sky(mi: Any, ambient: Ambient) -> dict[str, Any]:
    """Return the environment: one colour above the horizon, one below."""
    pixels = np.empty((_SKY_ROWS, 2 * _SKY_ROWS, 3), np.float32)
    pixels[: _SKY_ROWS // 2], pixels[_SKY_ROWS // 2 :] = ambient.above, ambient.below
    up = np.array(ambient.up) / np.linalg.norm(ambient.up)
    right, across, up = rotation_to_z(up)
    place = np.eye(4)
    place[:3, :3] = np.stack([right, up, -across], axis=1)  # Mitsuba's zenith is +y
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": mi.ScalarTransform4f(place)}
