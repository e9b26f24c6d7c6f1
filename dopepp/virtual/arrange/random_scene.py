"""Random scenes: from a preset, bodies and a generator to one :class:`Scene`.

A scale shows the same scene from nearer or farther: the camera moves, the world stays (paper Fig.
11). The camera goes along the ray to the middle of the targets and keeps its orientation and its
lens. So a single part stays at its place in the image and grows about as a picture of it would.
Objects, lamps and the plane keep their places in the world; light from everywhere, and the picture
behind objects in mid-air, are infinitely far away and do not change.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from dopepp.core.errors import UserError
from dopepp.geometry.camera import Transform, make_transform, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import Vector
from dopepp.virtual.arrange.composition import Composition
from dopepp.virtual.arrange.floating import arrange_floating
from dopepp.virtual.arrange.tabletop import arrange_on_table
from dopepp.virtual.backgrounds import Backgrounds
from dopepp.virtual.body import Body
from dopepp.virtual.presets.preset import Preset
from dopepp.virtual.presets.table import plane_of
from dopepp.virtual.scene import NEAR, Scene, SceneObject, triple


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
    has it: it decides from where the scene is seen, nothing else.

    Raises:
        UserError: The part is too large or too small for the preset to show it, or the scale takes
            the camera below the table.
    """
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
    objects = _moved_objects(composition.objects, shift)
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


def _moved_objects(objects: Iterable[SceneObject], shift: Vector) -> tuple[SceneObject, ...]:
    """Return objects after the move, without those that the camera has reached or passed."""
    there = (replace(item, T_cam_obj=_moved(item.T_cam_obj, shift)) for item in objects)
    return tuple(
        item for item in there if transform(item.T_cam_obj, item.surface.hull)[:, 2].min() > NEAR
    )


def _moved(T_cam: Transform, shift: Vector) -> Transform:
    return make_transform(T_cam[:3, :3], T_cam[:3, 3] + shift)
