"""Conversion of a scene for Mitsuba: meshes, reflectance, lamps, sky and film, in the camera frame.

Light matches ``raster.shading``: a lamp is a sphere with the illuminance of the point light, and
the sky is two hemispheres. All grooves are rendered as roughness, as if finer than a pixel. Noise
on the albedo is rendered on untextured surfaces only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int16

from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import CameraMatrix, crop_camera, transform
from dopepp.geometry.rotation import Vector, rotation_to_z
from dopepp.parts.mesh import face_areas
from dopepp.virtual.renderers.raster.visibility import Box
from dopepp.virtual.scene import NEAR, NOISE_LIMITS, Ambient, Light, Scene, SceneObject
from dopepp.virtual.sensor import SRGB_TO_LINEAR
from dopepp.virtual.surface import Surface

Sphere = tuple[Vector, float]  # centre and radius, camera frame, metres

LAMP_SHARE: Final = 0.06  # a lamp's radius / its distance: a bulb of 6 cm at half a metre
_MAX_ALBEDO: Final = 0.95  # a higher albedo would be unphysical and prolong paths
_VERTEX_COLOUR: Final = "vertex_colour"
_SKY_ROWS: Final = 64
_PANEL_SKY_ROWS: Final = 256  # pixels of 0.7°, a third of the narrowest panel
_NOISE_CELLS: Final = 64  # side of the repeating lattice of random albedos


def make_shapes(mi: Any, scene: Scene) -> list[Any]:
    """Return one Mitsuba mesh per object, in the scene's order."""
    reflectances = [
        mi.load_dict(_reflectance(mi, item, scene.K), parallel=False) for item in scene.objects
    ]
    return [_mesh(mi, *pair) for pair in zip(scene.objects, reflectances, strict=True)]


def make_surroundings(mi: Any, scene: Scene) -> dict[str, Any]:
    """Return the lamps and the sky as entries of Mitsuba's description of a scene."""
    entries: dict[str, Any] = {"sky": _sky(mi, scene.ambient)}
    bounds = bounding_sphere(scene)
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
    """Return a sphere around all objects of a scene with at least one object."""
    hulls = [transform(item.T_cam_obj, item.surface.hull) for item in scene.objects]
    points = np.concatenate(hulls)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return middle, float(np.linalg.norm(points - middle, axis=1).max())


def lamp_radius(light: Light, scene: Scene, bounds: Sphere) -> float:
    """Return a lamp's radius, metres: ``LAMP_SHARE`` of its distance, reduced close to objects."""
    position = np.array(light.position)
    distance = float(np.linalg.norm(position - bounds[0]))
    room = [float(np.linalg.norm(position))]
    for item in scene.objects:
        away = transform(item.T_cam_obj, item.surface.hull) - position
        room.append(float(np.linalg.norm(away, axis=1).min()))
    if scene.plane is not None:
        room.append(float(np.array(scene.plane.normal) @ position) - scene.plane.offset)
    # The sphere extends at most half of the way to an object, the camera or the table.
    return max(min(LAMP_SHARE * distance, 0.5 * min(room)), 1e-3)


def rgb(values: Vector) -> dict[str, Any]:
    """Return Mitsuba's description of a linear RGB colour."""
    return {"type": "rgb", "value": [float(value) for value in values]}


def _mesh(mi: Any, item: SceneObject, reflectance: Any) -> Any:
    """Return a Mitsuba mesh whose triangles share no vertex, because normals differ at creases."""
    surface, rotation = item.surface, item.T_cam_obj[:3, :3]
    corners = transform(item.T_cam_obj, surface.vertices)[surface.faces].reshape(-1, 3)
    properties = mi.Properties()
    properties["bsdf"] = reflectance
    counts = (len(corners), len(surface.faces))
    channels = {"has_vertex_normals": True, "has_vertex_texcoords": True}
    mesh = mi.Mesh(item.label, *counts, props=properties, **channels)
    parameters = mi.traverse(mesh)
    normals = surface.normals.reshape(-1, 3) @ rotation.T
    parameters["vertex_positions"] = np.ravel(corners).astype(np.float32)
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
    """Return each corner's texture coordinates; without a texture, its two coordinates in metres.

    The texture's v axis points down. Of the three coordinates, the one closest to the direction of
    the face's normal is omitted.
    """
    if len(surface.uv):
        uv = surface.uv[surface.faces].reshape(-1, 2)
        return np.asarray(np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1))
    corners = surface.vertices[surface.faces]
    facing = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axes = np.argsort(facing, axis=1, kind="stable")[:, None, :2]
    return np.asarray(np.take_along_axis(corners, np.sort(axes, axis=2), axis=2).reshape(-1, 2))


def _reflectance(mi: Any, item: SceneObject, K: CameraMatrix) -> dict[str, Any]:
    """Return Mitsuba's material: Lambert and GGX with a metallic workflow, on both sides."""
    material = item.material
    # Grooves widen the GGX roughness, whose square is α. A sine of largest slope s has the slope
    # variance s²/2 across the grooves, so s²/4 on average; α² is twice the variance.
    variance = material.roughness**4
    if material.grooves is not None:
        variance += material.grooves.slope**2 / 2
    root = math.sqrt(min(max(material.specular, 1e-4), 0.9))
    bsdf = {
        "type": "principled",
        "base_color": _colour(mi, item, K),
        "roughness": float(min(variance**0.25, 1.0)),
        "metallic": float(material.metallic),
        # Fresnel's reflectance at normal incidence, solved for the refractive index.
        "eta": (1 + root) / (1 - root),
    }
    return {"type": "twosided", "bsdf": bsdf}


def _colour(mi: Any, item: SceneObject, K: CameraMatrix) -> dict[str, Any]:
    """Return the linear albedo for Mitsuba: a constant, noise, vertex colours or a texture."""
    material, texture = item.material, item.surface.texture
    colour = np.asarray(material.colour, np.float32)
    if texture is not None:
        codes = texture.image(_texture_level(item, K))
        return _bitmap(mi, SRGB_TO_LINEAR[codes] * colour, np.eye(4))
    if len(item.surface.colours):
        return {"type": "mesh_attribute", "name": _VERTEX_COLOUR}
    if material.noise == 0.0:
        return rgb(np.clip(colour, 0.0, _MAX_ALBEDO))
    # The same random lattice for every object.
    cells = np.random.default_rng(0).uniform(-1, 1, (_NOISE_CELLS, _NOISE_CELLS, 1))
    scale = 1.0 / (_NOISE_CELLS * material.noise_pitch)
    tint = np.clip(1 + material.noise * cells, *NOISE_LIMITS)
    texels = (colour * tint).astype(np.float32)
    return _bitmap(mi, texels, np.diag([scale, scale, 1.0, 1.0]))


def _bitmap(
    mi: Any, texels: Float32[np.ndarray, "rows columns 3"], to_uv: np.ndarray
) -> dict[str, Any]:
    """Return Mitsuba's description of a texture of linear RGB; ``to_uv`` is a 4×4 transform."""
    bitmap = mi.Bitmap(np.clip(texels, 0.0, _MAX_ALBEDO))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "to_uv": mi.ScalarTransform4f(to_uv)}


def _texture_level(item: SceneObject, K: CameraMatrix) -> int:
    """Return the texture level with texels about half as large as the object's pixels."""
    surface, depth = item.surface, float(item.centre[2])
    assert surface.texture is not None
    levels = surface.texture.levels
    a, b, c = surface.uv[surface.faces].transpose(1, 2, 0)
    along, across = b - a, c - a
    used = float(np.abs(along[0] * across[1] - along[1] * across[0]).sum() / 2)
    if used == 0.0 or depth <= 0.0:
        return 0
    texels = used * levels[0, 1] * levels[0, 2]
    pixels = face_areas(surface.vertices, surface.faces).sum() * K[0, 0] * K[1, 1] / depth**2
    level = math.floor(0.5 * math.log2(max(texels / pixels, 1.0))) - 1
    return min(max(level, 0), len(levels) - 1)


def _sky(mi: Any, ambient: Ambient) -> dict[str, Any]:
    """Return Mitsuba's environment map: a colour above and below the horizon, and the panels."""
    rows = _PANEL_SKY_ROWS if ambient.panels else _SKY_ROWS
    pixels = np.empty((rows, 2 * rows, 3), np.float32)
    pixels[: rows // 2], pixels[rows // 2 :] = ambient.above, ambient.below
    up = np.array(ambient.up) / np.linalg.norm(ambient.up)
    right, across, up = rotation_to_z(up)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, up, -across], axis=1)  # Mitsuba's zenith is +y
    directions = _sky_directions(rows) @ pose[:3, :3].T
    for panel in ambient.panels:
        front = np.clip(0.5 + 2 * directions @ np.array(panel.middle), 0.0, 1.0)
        sideways = directions @ panel.across / panel.width
        lengthways = directions @ np.array(panel.along) / panel.length
        share = front * np.exp(-0.5 * (sideways**2 + lengthways**2))
        pixels += (share[..., None] * panel.intensity).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": mi.ScalarTransform4f(pose)}


def _sky_directions(rows: int) -> Float[np.ndarray, "rows columns 3"]:
    """Return the unit vectors to the pixels of an environment map, in Mitsuba's sky frame."""
    polar = (np.arange(rows) + 0.5)[:, None] / rows * np.pi
    azimuth = (np.arange(2 * rows) + 0.5) / rows * np.pi
    x, z = np.sin(azimuth) * np.sin(polar), -np.cos(azimuth) * np.sin(polar)
    return np.stack([x, np.broadcast_to(np.cos(polar), x.shape), z], axis=-1)


@dataclass(frozen=True, eq=False)
class Film:
    """A film with square pixels, as Mitsuba requires, over a window of the image.

    The film's pixels are at least as fine as the image's; non-square pixels are resampled.
    """

    window: Box
    size: Size  # (width, height) of the film, pixels
    focal_px: float  # Focal length, pixels of the film
    # Principal point; pixel (0, 0) is the centre of the film's first pixel.
    centre_px: tuple[float, float]
    # Affine map, 2×3, from the window's pixels to the film's.
    film_from_window: Float[np.ndarray, "2 3"]

    def sensor(self, mi: Any, samples: int) -> dict[str, Any]:
        """Return Mitsuba's description of the camera, with ``samples`` rays per pixel."""
        width, height = self.size
        return {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(width / 2 / self.focal_px)),
            "fov_axis": "x",
            # Fractions of the film, from the principal point to the middle at (width − 1)/2.
            "principal_point_offset_x": 0.5 - (self.centre_px[0] + 0.5) / width,
            "principal_point_offset_y": 0.5 - (self.centre_px[1] + 0.5) / height,
            "near_clip": NEAR,
            "far_clip": 1e4,
            # Mitsuba's camera frame has x to the left and y up.
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]),
            "sampler": {"type": "multijitter", "sample_count": samples},
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgba",
                "component_format": "float32",
                # Pixels share no samples, so the denoiser gets independent noise.
                "rfilter": {"type": "box"},
            },
        }

    def resampled(
        self, image: Float32[np.ndarray, "film_height film_width 4"]
    ) -> Float32[np.ndarray, "height width 4"]:
        """Return the film's RGBA image, resampled to the window's pixels."""
        left, top, right, bottom = self.window
        if np.array_equal(self.film_from_window, np.eye(2, 3)):
            return image
        size, flags = (right - left, bottom - top), cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        options = {"flags": flags, "borderMode": cv2.BORDER_REPLICATE}
        resampled = cv2.warpAffine(image, self.film_from_window, size, **options)
        return np.asarray(np.maximum(resampled, np.float32(0)))


def make_film(K: CameraMatrix, window: Box) -> Film:
    """Return the film that covers a window of the image."""
    left, top, right, bottom = window
    focal = float(max(K[0, 0], K[1, 1]))
    K_window = crop_camera(K, left, top)
    width, height = right - left, bottom - top
    if K[0, 0] == K[1, 1] and K[0, 1] == 0.0:
        centre = (float(K_window[0, 2]), float(K_window[1, 2]))
        return Film(window, (width, height), focal, centre, np.eye(2, 3))
    # The film's pixels are focal · ray − origin.
    rays = np.linalg.inv(K_window)[:2] * focal
    corners = np.array([(x, y, 1.0) for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    low, high = (corners @ rays.T).min(axis=0), (corners @ rays.T).max(axis=0)
    size = (math.ceil(high[0] - low[0]), math.ceil(high[1] - low[1]))
    rays[:, 2] -= low + 0.5
    return Film(window, size, focal, (-float(low[0]) - 0.5, -float(low[1]) - 0.5), rays)


def pixel_rays(K: CameraMatrix, window: Box) -> Float[np.ndarray, "height width 3"]:
    """Return the points (camera frame) at depth 1 m on the rays of a window's pixel centres."""
    left, top, right, bottom = window
    y, x = np.mgrid[top:bottom, left:right]
    return np.asarray(np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T)


def cast(
    mi: Any, world: Any, shapes: list[Any], rays: Float[np.ndarray, "height width 3"]
) -> tuple[Float32[np.ndarray, "height width"], Int16[np.ndarray, "height width"]]:
    """Return depth (metres; 0 without a hit) and index of the shape (−1 without) for each ray.

    ``rays`` are points at depth 1 m; hits nearer than ``NEAR`` are ignored.
    """
    flat = rays.reshape(-1, 3).astype(np.float32)
    if mi.variant().startswith("scalar"):
        distance, numbers = np.zeros(len(flat)), np.full(len(flat), -1)
        for index, (x, y, z) in enumerate(flat.tolist()):
            ray = mi.Ray3f(mi.Point3f(NEAR * x, NEAR * y, NEAR * z), mi.Vector3f(x, y, z))
            hit = world.ray_intersect_preliminary(ray, coherent=True)
            if hit.is_valid():
                distance[index] = hit.t
                numbers[index] = next(k for k, shape in enumerate(shapes) if shape == hit.shape)
    else:
        # The directions have z = 1, so the distance along a ray is its depth.
        origins, directions = mi.Point3f(flat.T * np.float32(NEAR)), mi.Vector3f(flat.T)
        hit = world.ray_intersect_preliminary(mi.Ray3f(origins, directions), coherent=True)
        owners = mi.Int32(-1)
        for number, shape in enumerate(shapes):
            owners[hit.is_valid() & (hit.shape == mi.ShapePtr(shape))] = number
        distance, numbers = np.array(hit.t), np.array(owners)
    depth = np.where(numbers >= 0, distance + NEAR, 0.0).astype(np.float32)
    return depth.reshape(rays.shape[:2]), numbers.astype(np.int16).reshape(rays.shape[:2])
