"""Random scenes: from a preset, parts and a generator to one :class:`Scene`."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.errors import UserError
from dopepp.geometry.camera import make_transform, project, resize_camera, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import random_rotation
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import Backgrounds
from dopepp.virtual.material import Material
from dopepp.virtual.presets import Preset
from dopepp.virtual.rasteriser import visible_fractions
from dopepp.virtual.scene import NEAR, Ambient, Light, Scene, SceneObject
from dopepp.virtual.shapes import distractor_shapes
from dopepp.virtual.surface import Surface

_TARGET_TRIES: Final = 200
"""Draws of a target's pose; in the preset ``paper`` about one of four has its centre in frame."""

_DISTRACTOR_TRIES: Final = 8
"""Draws of a distractor; one that still hides too much or pierces a target is left out."""

_PREVIEW_WIDTH: Final = 96
"""Width, pixels, at which visibility is judged while a scene is drawn."""

_NUM_PROBES: Final = 200
"""Surface points of a target that are looked at when something is put beside it."""

_CORE: Final = 0.6
"""The part of a bounding sphere's radius within which an object is taken as solid."""

_VISIBILITY_MARGIN: Final = 0.03
"""Added to the smallest visible fraction because a preview counts coarse pixels."""


def random_scene(
    preset: Preset,
    parts: Sequence[Part],
    rng: np.random.Generator,
    surfaces: Mapping[str, Surface],
    backgrounds: Backgrounds,
) -> Scene:
    """Draw a scene.

    Args:
        preset: Its distribution.
        parts: The parts to choose targets from.
        rng: Source of randomness; the scene is a pure function of its state.
        surfaces: The parts' prepared meshes by part name.
        backgrounds: Where the background comes from.

    Raises:
        UserError: The part is too large or too small for the preset to show it.
    """
    K, size = preset.K, (preset.width, preset.height)
    objects: list[SceneObject] = []
    count = int(rng.integers(preset.targets_per_image[0], preset.targets_per_image[1] + 1))
    order = rng.permutation(len(parts))
    for number in range(count):
        part = parts[int(order[number % len(parts)])]
        target = _draw_target(preset, part, surfaces[part.name], K, size, rng, objects)
        if target is not None:
            objects.append(target)
        elif not objects:
            raise UserError(
                f"part {part.name} of diameter {part.diameter:.3g} m, which found no place in "
                f"{_TARGET_TRIES} draws of preset {preset.name}",
                "a part that the preset's distances and field of view can show",
                "check the mesh's unit, or replace the preset's placement or field of view",
            )
    low, high = preset.distractors.number
    for _ in range(int(rng.integers(low, high + 1))):
        distractor = _draw_distractor(preset, K, size, rng, objects)
        if distractor is not None:
            objects.append(distractor)
    reach = float(np.mean([item.T_cam_obj[2, 3] for item in objects])) if objects else 1.0
    lights, ambient = _draw_light(preset, rng, np.array([0.0, 0.0, reach]))
    background = backgrounds.draw(rng, *size)
    return Scene(K, background, tuple(objects), lights, ambient)


def _draw_target(
    preset: Preset,
    part: Part,
    surface: Surface,
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    rng: np.random.Generator,
    others: list[SceneObject],
) -> SceneObject | None:
    """Draw a pose until the part is well in the frame; None if that never happens."""
    for _ in range(_TARGET_TRIES):
        rotation = preset.turning.draw(rng)
        hull = surface.hull @ rotation.T
        translation = preset.placement.draw(rng, K, size, hull)
        if (hull[:, 2] + translation[2]).min() <= NEAR:
            continue
        pose = make_transform(rotation, translation)
        centre = project(transform(pose, part.cuboid[CENTROID]), K)
        if preset.centroid_inside and not _inside(centre[None], size):
            continue
        target = SceneObject(surface, pose, _random_material(rng, surface), part)
        # A lone part whose outline lies in the frame needs no preview.
        alone = not others and _inside(project(hull + translation, K), size)
        if alone or _fits(preset, K, size, others, target):
            return target
    return None


def _draw_distractor(
    preset: Preset,
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    rng: np.random.Generator,
    others: list[SceneObject],
) -> SceneObject | None:
    """Draw a primitive that hides no target too much; None if that never happens."""
    shapes = distractor_shapes()
    ranges = preset.distractors
    for _ in range(_DISTRACTOR_TRIES):
        depth = float(others[0].T_cam_obj[2, 3] * rng.uniform(*ranges.depth))
        ray = np.linalg.solve(K, [*(rng.uniform(0, 1, 2) * size - 0.5), 1.0])
        radius = 0.5 * rng.uniform(*ranges.image_share) * size[0] * depth / K[0, 0]
        shape = shapes[int(rng.integers(len(shapes)))]
        surface = shape.scaled(radius * rng.uniform(0.5, 1.0, 3))
        pose = make_transform(random_rotation(rng), depth * ray)
        distractor = SceneObject(surface, pose, _random_material(rng, surface))
        if depth - radius > NEAR and _fits(preset, K, size, others, distractor):
            return distractor
    return None


def _inside(pixels: Float[np.ndarray, "points 2"], size: tuple[int, int]) -> bool:
    """Tell whether all pixels lie in the image."""
    return bool(((pixels >= -0.5) & (pixels < np.array(size) - 0.5)).all())


def _fits(
    preset: Preset,
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    others: list[SceneObject],
    new: SceneObject,
) -> bool:
    """Tell whether a new object pierces no other and leaves every target visible enough."""
    if any(_pierces(new, other) for other in others if other.is_target):
        return False
    scale = min(_PREVIEW_WIDTH / size[0], 1.0)
    width, height = round(size[0] * scale), round(size[1] * scale)
    preview = Scene(
        resize_camera(K, width / size[0], height / size[1]),
        np.empty((height, width, 3), np.uint8),
        (*others, new),
    )
    fractions = visible_fractions(preview)[list(preview.targets)]
    return bool((fractions >= preset.min_visible_fraction + _VISIBILITY_MARGIN).all())


def _pierces(new: SceneObject, target: SceneObject) -> bool:
    """Tell whether points of a target lie in the core of a new object."""
    assert target.part is not None
    points = transform(target.T_cam_obj, target.part.points[:_NUM_PROBES])
    centre = new.T_cam_obj[:3, 3]
    return bool(np.linalg.norm(points - centre, axis=1).min() < _CORE * new.surface.radius)


def _random_material(rng: np.random.Generator, surface: Surface) -> Material:
    """Draw a 3D print's look; a textured surface keeps its colours under a random brightness."""
    roughness = rng.uniform(0.25, 0.9)
    specular = rng.uniform(0.02, 0.07)
    noise, pitch = rng.uniform(0.0, 0.12), surface.radius * rng.uniform(0.02, 0.2)
    if len(surface.uv):
        colour = np.full(3, rng.uniform(0.7, 1.2))
        noise = 0.0
    else:
        kind = rng.random()
        if kind < 0.45:
            grey = rng.uniform(0.02, 0.85)
            colour = np.clip(grey * (1 + rng.uniform(-0.05, 0.05, 3)), 0.0, 0.9)
        else:
            hue, saturation, value = rng.uniform(0, 1), rng.uniform(0.2, 1.0), rng.uniform(0.3, 1.0)
            srgb = np.array(colorsys.hsv_to_rgb(hue, saturation, value))
            # 2.2 is the usual power for sRGB, exact enough for a random colour.
            colour = 0.9 * srgb**2.2
    return Material(
        (float(colour[0]), float(colour[1]), float(colour[2])), roughness, specular, noise, pitch
    )


def _draw_light(
    preset: Preset, rng: np.random.Generator, centre: Float[np.ndarray, "3"]
) -> tuple[tuple[Light, ...], Ambient]:
    """Draw point lights around a point of the scene, and the ambient light."""
    ranges = preset.lighting
    lights = []
    for number in range(int(rng.integers(ranges.num_lights[0], ranges.num_lights[1] + 1))):
        # Uniform over the spherical cap around the direction to the camera.
        cosine = rng.uniform(np.cos(np.radians(ranges.max_angle_deg)), 1.0)
        azimuth, sine = rng.uniform(0, 2 * np.pi), np.sqrt(1 - cosine**2)
        direction = np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), -cosine])
        reach = float(centre[2] * rng.uniform(*ranges.distance))
        strength = rng.uniform(*(ranges.fill_intensity if number else ranges.key_intensity))
        position = centre + reach * direction
        lights.append(Light(_triple(position), _triple(_tinted(ranges.tint, strength, rng)), reach))
    up = rng.normal(size=3) + np.array([0.0, -1.5, -0.5])
    above = _tinted(ranges.tint, rng.uniform(*ranges.ambient_intensity), rng)
    below = above * rng.uniform(0.3, 0.9)
    return tuple(lights), Ambient(_triple(up / np.linalg.norm(up)), _triple(above), _triple(below))


def _tinted(tint: float, strength: float, rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Return a nearly white light colour of a strength."""
    return np.asarray(strength * (1 + rng.uniform(-tint, tint, 3)))


def _triple(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
