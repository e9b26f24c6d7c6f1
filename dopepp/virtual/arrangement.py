"""Composition of a scene: add objects one by one while every target stays visible.

A small depth image of the accepted objects measures visibility. Each object is drawn once, alone,
so testing a candidate costs one object, not the whole scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    make_transform,
    project,
    resize_camera,
    transform,
)
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import random_rotation
from dopepp.virtual.body import Body
from dopepp.virtual.presets import Preset
from dopepp.virtual.renderers.raster.visibility import centres_within, draw_alone, project_object
from dopepp.virtual.scene import NEAR, Material, SceneObject

_REDRAWS: Final = 25  # positions to sample with one orientation; some orientations never fit


class Composition:
    """Objects of a scene, within a preset's limits; ``negatives`` are parts for distractors."""

    def __init__(self, preset: Preset, rng: Generator, negatives: Sequence[Body]) -> None:
        self.preset, self.rng, self.negatives = preset, rng, negatives
        self.K, self.size = preset.draw_camera(rng)
        self._alike = rng.random() < preset.materials.alike_share
        self._materials: dict[str, Material] = {}
        self.clear()

    def clear(self) -> None:
        """Remove all objects."""
        self.objects: list[SceneObject] = []
        self._preview = Preview(self.K, self.size, self.preset.min_visible_fraction)

    def draw_material(self, body: Body) -> Material:
        """Sample a material; instances of a part share it with probability ``alike_share``."""
        if body.part is None or not self._alike:
            return self.preset.materials.draw(self.rng, body.surface)
        name = body.part.name
        if name not in self._materials:
            self._materials[name] = self.preset.materials.draw(self.rng, body.surface)
        return self._materials[name]

    def draw_distractor(self, depth: float) -> Body:
        """Sample a distractor with the preset's image size at a depth in metres."""
        width_at_depth = self.size[0] * depth / float(self.K[0, 0])
        return self.preset.distractors.draw(self.rng, width_at_depth, self.negatives)

    def add(self, body: Body, T_cam_obj: Transform, material: Material) -> bool:
        """Add a body if every target stays within the preset's limits; return True if added."""
        extremes = transform(T_cam_obj, body.surface.hull)
        if extremes[:, 2].min() <= NEAR:
            return False
        item = SceneObject(body.surface, T_cam_obj, material, body.part)
        if not (self._is_well_placed(item, extremes) and self._preview.add(item)):
            return False
        self.objects.append(item)
        return True

    def _is_well_placed(self, item: SceneObject, extremes: Float[np.ndarray, "hull 3"]) -> bool:
        """Return whether a target spans 2 pixels and its centroid is in the preset's ranges."""
        if item.part is None:
            return True
        middle = transform(item.T_cam_obj, item.part.cuboid[CENTROID])
        nearest, farthest = self.preset.depths or (0.0, np.inf)
        if not nearest <= middle[2] <= farthest:
            return False
        if self.preset.centroid_inside:
            centre = project(middle, self.K)
            if not ((centre >= -0.5) & (centre < np.array(self.size) - 0.5)).all():
                return False
        return bool(np.ptp(project(extremes, self.K), axis=0).max() >= 2.0)


class Preview:
    """Depth image of the accepted objects, at most 160 pixels wide, to measure visibility."""

    def __init__(self, K: CameraMatrix, size: Size, min_visible: float) -> None:
        scale = min(160 / size[0], 1.0)  # smaller images keep their size
        self._size = width, height = tuple(max(round(side * scale), 1) for side in size)
        self._K = resize_camera(K, width / size[0], height / size[1])
        self._least = min_visible + 0.03  # margin for the errors of coarse pixels
        self._nearest = np.zeros((height, width), np.float32)
        self._owners = np.full((height, width), -1, np.int64)
        self._visible: list[int] = []
        self._needed: list[float] = []

    def add(self, item: SceneObject) -> bool:
        """Add an object, and return True, if each target keeps its minimum visible fraction.

        An object that reaches the camera or is over four times as long as the image is rejected.
        """
        projected, (width, height) = project_object(item, self._K), self._size
        left, top, right, bottom = projected.extent
        if not max(right - left, bottom - top) <= 4 * max(width, height):
            return False
        box = centres_within(projected.extent)
        inverse_depth = draw_alone(item, projected.hom, box)[0]
        whole = int(np.count_nonzero(inverse_depth))
        if item.is_target and whole == 0:
            return False
        # The pixels of the box within the frame, as slices of the frame and of the box.
        left, top = max(box[0], 0), max(box[1], 0)
        right, bottom = max(min(box[2], width), left), max(min(box[3], height), top)
        frame = slice(top, bottom), slice(left, right)
        canvas = slice(top - box[1], bottom - box[1]), slice(left - box[0], right - box[0])
        drawn, nearest = inverse_depth[canvas], self._nearest[frame]
        # At equal depth the earlier object is visible, as in the renderer.
        in_front = drawn > nearest
        hidden = self._owners[frame][in_front]
        losses = np.bincount(hidden[hidden >= 0], minlength=len(self._visible))
        remaining = [px - int(loss) for px, loss in zip(self._visible, losses, strict=True)]
        drawn_px = int(np.count_nonzero(in_front))
        needed = self._least * whole if item.is_target else 0.0
        if (np.array([*remaining, drawn_px]) < [*self._needed, needed]).any():
            return False
        nearest[in_front] = drawn[in_front]
        self._owners[frame][in_front] = len(remaining)
        self._visible = [*remaining, drawn_px]
        self._needed.append(needed)
        return True


def arrange_floating(
    composition: Composition, targets: Sequence[Body], reference_body: Body
) -> float:
    """Add targets and distractors to a composition, and return the targets' mean depth, metres.

    Depths are those of the centres of bounding boxes. If no pose of the first target is accepted,
    no target is added. Without targets, the depth is a sampled depth of ``reference_body``.
    """
    for body in targets:
        material = composition.draw_material(body)
        # In the preset ``paper``, four of five first poses are accepted.
        for pose in islice(_poses(composition, body), 200):
            if _is_clear(composition, body, pose) and composition.add(body, pose, material):
                break
        if not composition.objects:
            break
    depths = [float(item.centre[2]) for item in composition.objects]
    if not depths:
        pose = _draw_pose(composition, reference_body)
        depths = [max(float(transform(pose, reference_body.surface.centre)[2]), NEAR)]
    low, high = composition.preset.distractors.number
    for _ in range(int(composition.rng.integers(low, high + 1))):
        _place_distractor(composition, depths[0])
    return float(np.mean(depths))


def _draw_pose(composition: Composition, body: Body) -> Transform:
    """Sample T_cam_obj from the preset's turning and placement."""
    preset, rng = composition.preset, composition.rng
    rotation, centre = preset.turning.draw(rng), body.surface.centre
    turned = (body.surface.hull - centre) @ rotation.T
    position = preset.placement.draw(rng, composition.K, composition.size, turned)
    return make_transform(rotation, position - rotation @ centre)


def _poses(composition: Composition, body: Body) -> Iterator[Transform]:
    """Yield poses T_cam_obj; up to :data:`_REDRAWS` of them share an orientation."""
    while True:
        pose = _draw_pose(composition, body)
        offset = pose[:3, :3] @ body.surface.centre
        for _ in range(_REDRAWS):
            yield pose
            centre = composition.preset.placement.redraw(composition.rng, pose[:3, 3] + offset)
            if centre is None:
                break
            pose = make_transform(pose[:3, :3], centre - offset)


def _place_distractor(composition: Composition, reference: float) -> None:
    """Try up to eight times to add a distractor that neither intersects nor hides a target.

    The preset's range of distractor depths is multiplied by the depth ``reference``, metres.
    """
    rng, ranges = composition.rng, composition.preset.distractors
    for _ in range(8):
        depth = reference * rng.uniform(*ranges.depth)
        pixel = rng.uniform(0, 1, 2) * composition.size - 0.5
        rotation = random_rotation(rng)
        body = composition.draw_distractor(depth)
        position = depth * np.linalg.solve(composition.K, [*pixel, 1.0])
        pose = make_transform(rotation, position - rotation @ body.surface.centre)
        if not _is_clear(composition, body, pose):
            continue
        if composition.add(body, pose, composition.draw_material(body)):
            return


def _is_clear(composition: Composition, body: Body, T_cam_obj: Transform) -> bool:
    """Return whether all targets lie outside 60 % of the new object's bounding radius."""
    centre, core = transform(T_cam_obj, body.surface.centre), 0.6 * body.surface.radius
    for target in composition.objects:
        distance = float(np.linalg.norm(target.centre - centre))
        if target.part is None or distance > core + target.surface.radius:
            continue
        probes = target.part.points[:: max(len(target.part.points) // 200, 1)]
        points = transform(target.T_cam_obj, probes)
        if np.linalg.norm(points - centre, axis=1).min() < core:
            return False
    return True
