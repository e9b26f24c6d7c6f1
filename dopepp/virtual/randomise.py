"""Random scenes: from a preset, bodies and a generator to one :class:`Scene`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dopepp.errors import UserError
from dopepp.virtual.afloat import arrange_afloat
from dopepp.virtual.approach import approach, moved, moved_lights, moved_objects
from dopepp.virtual.backgrounds import Backgrounds
from dopepp.virtual.body import Body
from dopepp.virtual.composition import Composition
from dopepp.virtual.presets import Preset
from dopepp.virtual.scene import Scene
from dopepp.virtual.table import plane_of
from dopepp.virtual.tabletop import arrange_on_table


def random_scene(
    preset: Preset,
    targets: Sequence[Body],
    negatives: Sequence[Body],
    rng: np.random.Generator,
    backgrounds: Backgrounds,
    scale: float = 1.0,
) -> Scene:
    """Draw a scene.

    Args:
        preset: Its distribution.
        targets: The parts' bodies to choose targets from.
        negatives: The bodies that a distractor may be instead of a primitive.
        rng: Source of randomness; the scene is a pure function of its state.
        backgrounds: Where the background comes from.
        scale: How many times as large the targets appear as the preset has it; see
            :mod:`dopepp.virtual.approach`. It decides from where the scene is seen, nothing else.

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
        depth = arrange_afloat(composition, chosen, targets[int(order[0])])
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
        T_cam_table = moved(T_cam_table, shift)
        plane = plane_of(T_cam_table)
        if plane.offset >= 0:
            raise _below_table(scale)
        background = picture.seen(composition.K, composition.size, T_cam_table)
    if chosen and not any(item.is_target for item in composition.objects):
        raise _unshowable(chosen[0], preset)
    sensor = preset.sensors.draw(rng)
    return Scene(
        composition.K,
        background,
        moved_objects(composition.objects, shift),
        moved_lights(lights, shift),
        ambient,
        plane,
        sensor,
    )


def _below_table(scale: float) -> UserError:
    return UserError(
        f"scale {scale:g} of a scene whose parts reach higher than the camera",
        "a scale at which the camera is above the table",
        "choose a larger scale",
    )


def _unshowable(body: Body, preset: Preset) -> UserError:
    assert body.part is not None
    return UserError(
        f"part {body.part.name} of diameter {body.part.diameter:.3g} m, which found no place in "
        f"any draw of preset {preset.name}",
        "a part that the preset's distances and field of view can show",
        "check the mesh's unit, or replace the preset's distances or field of view",
    )
