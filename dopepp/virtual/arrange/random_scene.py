"""Random scenes: from a preset, bodies and a generator to one :class:`Scene`.

Objects lie on a table (``tabletop``) or, as in the paper, float in mid-air.

A scale shows the same scene from nearer or farther: the camera moves, the world stays (paper Fig.
11). The camera goes along the ray to the middle of the targets and keeps its orientation and its
lens. So a single part stays at its place in the image and grows about as a picture of it would.
Objects, lamps and the plane keep their places in the world; light from everywhere, and the picture
behind objects in mid-air, are infinitely far away and do not change.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from typing import Final

import numpy as np
from numpy.random import Generator

from dopepp.core.errors import UserError
from dopepp.geometry.camera import Transform, make_transform, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import Vector, random_rotation
from dopepp.virtual.arrange.composition import Composition
from dopepp.virtual.arrange.tabletop import arrange_on_table
from dopepp.virtual.backgrounds import Backgrounds
from dopepp.virtual.backgrounds.cluttered import ClutteredBackgrounds
from dopepp.virtual.body import Body
from dopepp.virtual.presets.preset import Preset
from dopepp.virtual.presets.table import plane_of
from dopepp.virtual.scene import NEAR, Scene, SceneObject, triple

_REDRAWS: Final = 25
"""Poses to try before all of a pose is drawn anew, so that a place without any depth for the part
ends nothing; in 20,000 scenes of the preset ``paper`` with the paper's parts none was given up."""


def random_scene(
    preset: Preset,
    targets: Sequence[Body],
    negatives: Sequence[Body],
    rng: Generator,
    backgrounds: Backgrounds,
    scale: float = 1.0,
) -> Scene:
    """Draw a scene.

    The scene is a pure function of the state of ``rng``. A distractor may be one of ``negatives``
    instead of a primitive. ``scale`` is how many times as large the targets appear as the preset
    has it: it decides from where the scene is seen, nothing else. A UserError: the part is too
    large or too small for the preset to show it, or the scale takes the camera below the table.
    """
    if any(preset.clutter) or preset.background_contrast != (1.0, 1.0):
        backgrounds = ClutteredBackgrounds(backgrounds, preset.clutter, preset.background_contrast)
    order = rng.permutation(len(targets))
    low, high = preset.targets_per_image
    count = int(rng.integers(low, high + 1))
    chosen = [targets[int(order[number % len(targets)])] for number in range(count)]
    composition = Composition(preset, rng, negatives)
    if preset.table is None:
        # An image without targets has its distractors where a target's would be.
        depth = arrange_floating(composition, chosen, targets[int(order[0])])
        shift = approach(composition.objects, scale)
        lights, ambient = preset.lighting.draw(rng, np.array([0.0, 0.0, depth]))
        background, plane = backgrounds.draw(rng, *composition.size), None
    else:
        T_cam_table = arrange_on_table(composition, preset.table, chosen)
        shift = approach(composition.objects, scale)
        lights, ambient = preset.lighting.draw(rng, T_cam_table[:3, 3], T_cam_table[:3, 2])
        picture = preset.table.draw_picture(
            rng, backgrounds, composition.K, composition.size, T_cam_table
        )
        T_cam_table = _moved(T_cam_table, shift)
        plane = plane_of(T_cam_table)
        if plane.offset >= 0:
            raise UserError(
                f"scale {scale:g} of a scene whose parts reach higher than the camera",
                "a scale at which the camera is above the table",
                "choose a larger scale",
            )
        background = picture.seen(composition.K, composition.size, T_cam_table)
    if chosen and not any(item.is_target for item in composition.objects):
        part = chosen[0].part
        assert part is not None
        raise UserError(
            f"part {part.name} of diameter {part.diameter:.3g} m, which found no place in any draw "
            f"of preset {preset.name}",
            "a part that the preset's distances and field of view can show",
            "check the mesh's unit, or replace the preset's distances or field of view",
        )
    there = (replace(item, T_cam_obj=_moved(item.T_cam_obj, shift)) for item in composition.objects)
    # The camera may have reached or passed some of them.
    objects = tuple(
        item for item in there if transform(item.T_cam_obj, item.surface.hull)[:, 2].min() > NEAR
    )
    # How strongly a lamp lights the scene stays the same.
    lights = tuple(
        replace(light, position=triple(np.array(light.position) + shift)) for light in lights
    )
    sensor = preset.sensors.draw(rng)
    return Scene(composition.K, background, objects, lights, ambient, plane, sensor)


def approach(objects: Sequence[SceneObject], scale: float) -> Vector:
    """Return by how much the world moves in the camera frame, metres.

    The distance from the camera to the mean of the targets' cuboids' centres is divided by the
    positive ``scale``: as many times as large they appear. Without a target the camera stays.
    """
    centres = [
        transform(item.T_cam_obj, item.part.cuboid[CENTROID])
        for item in objects
        if item.part is not None
    ]
    if not centres or scale == 1:
        return np.zeros(3)
    return np.asarray((1 / scale - 1) * np.mean(centres, axis=0))


def _moved(T_cam: Transform, shift: Vector) -> Transform:
    return make_transform(T_cam[:3, :3], T_cam[:3, 3] + shift)


def arrange_floating(composition: Composition, targets: Sequence[Body], usual: Body) -> float:
    """Place targets and distractors, and return the targets' mean depth, metres.

    There are no targets if the first finds no place; ``usual`` is the body to take the depth from
    where there is no target.
    """
    for body in targets:
        if not _place_target(composition, body) and not composition.objects:
            break
    depths = [float(item.T_cam_obj[2, 3]) for item in composition.objects]
    if not depths:
        depths = [max(float(_draw_pose(composition, usual)[2, 3]), NEAR)]
    low, high = composition.preset.distractors.number
    for _ in range(int(composition.rng.integers(low, high + 1))):
        _place_distractor(composition, depths[0])
    return float(np.mean(depths))


def _draw_pose(composition: Composition, body: Body) -> Transform:
    preset, rng = composition.preset, composition.rng
    rotation = preset.turning.draw(rng)
    turned = body.surface.hull @ rotation.T
    place = preset.placement.draw(rng, composition.K, composition.size, turned)
    return make_transform(rotation, place)


def _poses(composition: Composition, body: Body) -> Iterator[Transform]:
    """Yield poses to try, each drawn when it is asked for; what the placement keeps comes again."""
    while True:
        pose = _draw_pose(composition, body)
        for _ in range(_REDRAWS):
            yield pose
            place = composition.preset.placement.redraw(composition.rng, pose[:3, 3])
            if place is None:
                break
            pose = make_transform(pose[:3, :3], place)


def _place_target(composition: Composition, body: Body) -> bool:
    """Draw a pose until the part is well in the frame; tell whether that happened."""
    material = composition.draw_material(body)
    # Of the preset ``paper``, four of five first poses are accepted.
    for pose in islice(_poses(composition, body), 200):
        if _is_clear(composition, body, pose) and composition.add(body, pose, material):
            return True
    return False


def _place_distractor(composition: Composition, reference: float) -> None:
    """Draw a distractor up to eight times, until it pierces no target and hides none too much."""
    rng, ranges = composition.rng, composition.preset.distractors
    for _ in range(8):
        depth = reference * rng.uniform(*ranges.depth)
        pixel = rng.uniform(0, 1, 2) * composition.size - 0.5
        pose = make_transform(
            random_rotation(rng), depth * np.linalg.solve(composition.K, [*pixel, 1.0])
        )
        body = composition.draw_distractor(depth)
        if not _is_clear(composition, body, pose):
            continue
        if composition.add(body, pose, composition.draw_material(body)):
            return


def _is_clear(composition: Composition, body: Body, T_cam_obj: Transform) -> bool:
    """Tell whether no target reaches into the core of a new object."""
    # Of the bounding sphere's radius, so much is taken as solid.
    centre, core = T_cam_obj[:3, 3], 0.6 * body.surface.radius
    for target in composition.objects:
        away = float(np.linalg.norm(target.T_cam_obj[:3, 3] - centre))
        if target.part is None or away > core + target.surface.radius:
            continue
        probes = target.part.points[:: max(len(target.part.points) // 200, 1)]
        points = transform(target.T_cam_obj, probes)
        if np.linalg.norm(points - centre, axis=1).min() < core:
            return False
    return True
