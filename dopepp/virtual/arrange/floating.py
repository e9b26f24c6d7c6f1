"""Objects in mid-air, as in the paper: any turning and place that the preset allows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final

import numpy as np

from dopepp.geometry.camera import Transform, make_transform, transform
from dopepp.geometry.rotation import random_rotation
from dopepp.virtual.arrange.composition import Composition
from dopepp.virtual.body import Body
from dopepp.virtual.scene import NEAR

_TARGET_TRIES: Final = 200
"""Poses of a target to try; four of five first ones of the preset ``paper`` are accepted."""

_REDRAWS: Final = 25
"""Poses to try before all of a pose is drawn anew, so that a place without any depth for the part
ends nothing; in 20,000 scenes of the preset ``paper`` with the paper's parts none was given up."""

_DISTRACTOR_TRIES: Final = 8
"""Draws of a distractor; one that still hides too much or pierces a target is left out."""

_NUM_PROBES: Final = 200
"""Surface points of a target that are looked at when something is put beside it."""

_CORE: Final = 0.6
"""The part of a bounding sphere's radius within which an object is taken as solid."""


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
    for pose in islice(_poses(composition, body), _TARGET_TRIES):
        if _is_clear(composition, body, pose) and composition.add(body, pose, material):
            return True
    return False


def _place_distractor(composition: Composition, reference: float) -> None:
    """Draw a distractor until it hides no target too much, or give up."""
    rng, ranges = composition.rng, composition.preset.distractors
    for _ in range(_DISTRACTOR_TRIES):
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
    centre, core = T_cam_obj[:3, 3], _CORE * body.surface.radius
    for target in composition.objects:
        away = float(np.linalg.norm(target.T_cam_obj[:3, 3] - centre))
        if target.part is None or away > core + target.surface.radius:
            continue
        probes = target.part.points[:: max(len(target.part.points) // _NUM_PROBES, 1)]
        points = transform(target.T_cam_obj, probes)
        if np.linalg.norm(points - centre, axis=1).min() < core:
            return False
    return True
