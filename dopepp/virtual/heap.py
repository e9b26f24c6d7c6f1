"""Heaps: objects that physics has dropped into a bin or onto the open table.

A heap's objects are sampled with the heap's number as seed, simulated once and cached
(``physics``). Each image of a heap turns and shifts the heap, and samples its own view, materials
and light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from dopepp.core.errors import UserError
from dopepp.geometry.camera import Transform, focal_length, make_transform, project, transform
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix
from dopepp.virtual.arrangement import Composition
from dopepp.virtual.body import Body, bin_pieces, bin_walls
from dopepp.virtual.presets.table import Pile, Table
from dopepp.virtual.scene import NEAR, SceneObject
from dopepp.virtual.tabletop import draw_view

_IMAGE_WIDTH: Final = 5.0  # width of the image for the size of distractors, diameters
_LARGEST: Final = 2.0  # largest diameter of a negative, in diameters of the largest target
_GAP: Final = 0.01  # smallest distance between layers of falling objects, diameters
_MIN_ROOM: Final = 1.2  # smallest side of the drop area, diameters
_TRIALS: Final = 8
_BESIDE: Final = 1.0  # objects beside a window are omitted if farther than this, diameters

Sides = Float[np.ndarray, "3"]  # inner width, depth and height of a bin, metres


def arrange_heap(
    composition: Composition, table: Table, pile: Pile, targets: Sequence[Body], drawing: Generator
) -> Transform:
    """Add a heap of targets and distractors to a composition, and sample a view of the heap.

    The composition's generator samples the view and the materials, ``drawing`` the heap's objects
    and poses.

    Returns:
        T_cam_table (plane z = 0, z up). Without a view that shows a target, no object is added.

    Raises:
        UserError: The objects do not come to rest.
    """
    preset, rng = composition.preset, composition.rng
    diameters = (body.surface.diameter for body in targets)
    diameter = max(diameters, default=0.3 * table.distance[0])
    bodies, limit = list(targets), _LARGEST * diameter
    negatives = [body for body in composition.negatives if body.surface.diameter < limit]
    low, high = preset.distractors.number
    for _ in range(int(drawing.integers(low, high + 1))):
        bodies.append(preset.distractors.draw(drawing, _IMAGE_WIDTH * diameter, negatives))
    bodies = [bodies[index] for index in drawing.permutation(len(bodies))]
    poses, sides = _drop(bodies, pile, diameter, drawing)
    if sides is not None:
        bodies, poses = [*bodies, bin_walls().stretched(sides)], [*poses, np.eye(4)]
    materials = [composition.draw_material(body) for body in bodies]
    reach = np.abs([pose[:2, 3] for pose in poses]).max(initial=0.0)
    beside = math.inf
    if preset.window is not None:  # a window shows few of the objects
        beside = _BESIDE * diameter * focal_length(composition.K)
    for trial in range(_TRIALS):
        T_cam_table = draw_view(table, composition)
        turn = rotation_vector_to_matrix(np.array([0.0, 0.0, rng.uniform(0, 2 * np.pi)]))
        shift = np.array([*rng.uniform(-pile.aside, pile.aside, 2) * reach, 0.0])
        T_cam_pile = T_cam_table @ make_transform(turn, shift)
        objects: list[SceneObject] = []
        for body, pose, material in zip(bodies, poses, materials, strict=True):
            T_cam_obj = T_cam_pile @ pose
            hull = transform(T_cam_obj, body.surface.hull)
            if hull[:, 2].min() <= NEAR:
                if trial + 1 < _TRIALS:
                    break
                continue  # a high heap around the camera is shown without its top
            image = project(hull, composition.K)
            lower, upper = image.min(axis=0), image.max(axis=0)
            outside = np.max([-0.5 - upper, lower - np.array(composition.size) + 0.5])  # pixels
            if outside > beside / hull[:, 2].min():
                continue
            # A part below two pixels is not recognisable.
            part = body.part if outside < 0 and (upper - lower).max() >= 2.0 else None
            objects.append(SceneObject(body.surface, T_cam_obj, material, part))
        else:
            if not targets or any(item.is_target for item in objects):
                composition.objects = objects
                break
    return T_cam_table


def _drop(
    bodies: Sequence[Body], pile: Pile, diameter: float, rng: Generator
) -> tuple[Sequence[Transform], Sides | None]:
    """Return the bodies' poses T_table_obj at rest, and the sides of their bin (None: no bin)."""
    from dopepp.virtual.physics import settle  # needs the extra ``robot``

    if not bodies:
        return [], None
    # The mean side of the objects' bounding boxes.
    size = np.mean([np.ptp(body.hull.vertices, axis=0).prod() ** (1 / 3) for body in bodies])
    for _ in range(_TRIALS):
        room = max(rng.uniform(*pile.room) * size * np.sqrt(len(bodies)), _MIN_ROOM * diameter)
        stretch, height = rng.uniform(0.8, 1.25), diameter * rng.uniform(*pile.wall_height)
        sides = np.array([room * stretch, room / stretch, height])
        has_bin = rng.random() < pile.bin_share
        starts = _layers(bodies, sides, diameter, rng)
        walls = [sides * piece for piece in bin_pieces()] if has_bin else []
        poses = settle([body.pieces for body in bodies], starts, walls, diameter)
        if poses is not None:
            return list(poses), sides if has_bin else None
    raise UserError(
        f"a heap of {len(bodies)} objects that do not come to rest in {_TRIALS} trials",
        "objects that settle without overlaps",
        "check the mesh and its unit with --preview, or use the preset bin",
    )


def _layers(
    bodies: Sequence[Body], sides: Sides, diameter: float, rng: Generator
) -> Float[np.ndarray, "bodies 4 4"]:
    """Return random poses T_table_obj without contact, in layers above the drop area."""
    most = np.maximum((sides[:2] / diameter).astype(int), 1)
    top, poses = 0.0, []
    free: list[list[int]] = []
    for body in bodies:
        if not free:
            base = top + _GAP * diameter
            # Grids differ between layers, so that the heap does not show a grid.
            grid = rng.integers((most + 1) // 2, most + 1)
            free = rng.permutation(np.indices(grid).reshape(2, -1).T).tolist()
        rotation = random_rotation(rng)
        turned = body.hull.vertices @ rotation.T
        lower, upper = turned.min(axis=0), turned.max(axis=0)
        cell = sides[:2] / grid
        spare = np.maximum(cell - (upper - lower)[:2], 0.0) / 2
        middle = (np.array(free.pop()) + 0.5) * cell - sides[:2] / 2 + rng.uniform(-spare, spare)
        position = np.array([*(middle - (lower + upper)[:2] / 2), base - lower[2]])
        top = max(top, float(position[2] + upper[2]))
        poses.append(make_transform(rotation, position))
    return np.stack(poses)
