"""A scene in the making: what is in it so far, and whether one more object fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import project, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.virtual.body import Body
from dopepp.virtual.material import Material
from dopepp.virtual.presets import Preset
from dopepp.virtual.preview import Preview
from dopepp.virtual.scene import NEAR, SceneObject

_SMALLEST_PX: Final = 2.0
"""A target whose image is smaller than this both ways is not shown by any camera."""


class Composition:
    """Objects that a preset accepts beside each other.

    Args:
        preset: The distribution of scenes.
        rng: Source of randomness.
        negatives: The bodies that a distractor may be instead of a primitive.
    """

    def __init__(self, preset: Preset, rng: np.random.Generator, negatives: Sequence[Body]) -> None:
        self.preset, self.rng, self.negatives = preset, rng, negatives
        self.K, self.size = preset.K, (preset.width, preset.height)
        self._alike = rng.random() < preset.materials.alike_share
        self._materials: dict[str, Material] = {}
        self.clear()

    def clear(self) -> None:
        """Take every object out again."""
        self.objects: list[SceneObject] = []
        self._preview = Preview(self.K, self.size, self.preset.min_visible_fraction)

    def draw_material(self, body: Body) -> Material:
        """Draw what a body is made of; a part's instances may all be made of the same."""
        if body.part is None or not self._alike:
            return self.preset.materials.draw(self.rng, body.surface)
        name = body.part.name
        if name not in self._materials:
            self._materials[name] = self.preset.materials.draw(self.rng, body.surface)
        return self._materials[name]

    def draw_distractor(self, depth: float) -> Body:
        """Draw a distractor for a depth in metres."""
        width_at_depth = self.size[0] * depth / float(self.K[0, 0])
        return self.preset.distractors.draw(self.rng, width_at_depth, self.negatives)

    def add(self, body: Body, T_cam_obj: Float[np.ndarray, "4 4"], material: Material) -> bool:
        """Add a body where it stands before the camera and no target is hidden too much.

        Returns:
            Whether it was added.
        """
        extremes = transform(T_cam_obj, body.surface.hull)
        if extremes[:, 2].min() <= NEAR:
            return False
        item = SceneObject(body.surface, T_cam_obj, material, body.part)
        if not (self._is_well_placed(item, extremes) and self._preview.add(item)):
            return False
        self.objects.append(item)
        return True

    def _is_well_placed(self, item: SceneObject, extremes: Float[np.ndarray, "hull 3"]) -> bool:
        """Tell whether a target is neither tiny nor has its centre outside of the frame."""
        if item.part is None:
            return True
        if self.preset.centroid_inside:
            centre = project(transform(item.T_cam_obj, item.part.cuboid[CENTROID]), self.K)
            if not ((centre >= -0.5) & (centre < np.array(self.size) - 0.5)).all():
                return False
        return bool(np.ptp(project(extremes, self.K), axis=0).max() >= _SMALLEST_PX)
