"""A scene in the making: what is in it so far, and whether one more object fits.

A small depth image of the scene so far: does one more object leave every target visible?

Each object is drawn once, alone; trying another costs that one object, not the whole scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Float32

from dopepp.geometry.camera import project, resize_camera, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.virtual.arrange.body import Body
from dopepp.virtual.presets.preset import Preset
from dopepp.virtual.renderers.raster.visibility import (
    CENTRE_SAMPLE,
    bounds,
    project_vertices,
    rasterise,
)
from dopepp.virtual.scene import NEAR, Material, SceneObject

_WIDTH_PX: Final = 160
"""Width of the depth image; smaller images are looked at as they are."""

_WIDEST: Final = 4.0
"""An object whose image is longer than so many frames is none that a camera is pointed at."""

_MARGIN: Final = 0.03
"""Added to the smallest visible fraction, because coarse pixels are counted."""


@dataclass(frozen=True, eq=False)
class _Layer:
    """One object's depth image, on a canvas as large as the object needs.

    Attributes:
        inverse_depth: 1/m, 0 where the object is not.
        left: Column of the frame at the canvas's first column.
        top: Row of the frame at the canvas's first row.
        num_px: Pixels of the whole silhouette.
    """

    inverse_depth: Float32[np.ndarray, "rows columns"]
    left: int
    top: int
    num_px: int


class Preview:
    """The objects accepted so far, seen coarsely.

    Args:
        K: Camera matrix of the image, pixels.
        size: Image (width, height), pixels.
        min_visible: Smallest visible fraction of every target.
    """

    def __init__(
        self, K: Float[np.ndarray, "3 3"], size: tuple[int, int], min_visible: float
    ) -> None:
        scale = min(_WIDTH_PX / size[0], 1.0)
        self._width, self._height = max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)
        self._K = resize_camera(K, self._width / size[0], self._height / size[1])
        self._least = min_visible + _MARGIN
        self._nearest = np.zeros((self._height, self._width), np.float32)
        self._owners = np.full((self._height, self._width), -1, np.int64)
        self._visible: list[int] = []
        self._needed: list[float] = []

    def add(self, item: SceneObject) -> bool:
        """Add an object if every target, itself included, stays visible enough.

        Returns:
            Whether it was added; if not, nothing has changed.
        """
        layer = self._draw(item)
        if layer is None or (item.is_target and layer.num_px == 0):
            return False
        frame, canvas = self._overlap(layer)
        drawn, nearest = layer.inverse_depth[canvas], self._nearest[frame]
        # At equal depth the first stays, as in the renderer.
        in_front = drawn > nearest
        hidden = self._owners[frame][in_front]
        losses = np.bincount(hidden[hidden >= 0], minlength=len(self._visible))
        left = [have - int(loss) for have, loss in zip(self._visible, losses, strict=True)]
        own = int(np.count_nonzero(in_front))
        needed = self._least * layer.num_px if item.is_target else 0.0
        if own < needed or any(px < least for px, least in zip(left, self._needed, strict=True)):
            return False
        nearest[in_front] = drawn[in_front]
        self._owners[frame][in_front] = len(left)
        self._visible = [*left, own]
        self._needed.append(needed)
        return True

    def _overlap(self, layer: _Layer) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Return the common pixels of frame and layer, as slices of either."""
        rows, columns = layer.inverse_depth.shape
        top, bottom = max(layer.top, 0), min(layer.top + rows, self._height)
        left, right = max(layer.left, 0), min(layer.left + columns, self._width)
        bottom, right = max(bottom, top), max(right, left)
        frame = slice(top, bottom), slice(left, right)
        canvas = (
            slice(top - layer.top, bottom - layer.top),
            slice(left - layer.left, right - layer.left),
        )
        return frame, canvas

    def _draw(self, item: SceneObject) -> _Layer | None:
        """Draw an object alone; None if it reaches the camera or is far larger than the frame."""
        surface = item.surface
        cam, hom = np.empty_like(surface.vertices), np.empty_like(surface.vertices)
        project_vertices(surface.vertices, item.T_cam_obj, self._K, cam, hom)
        left, top, right, bottom = bounds(hom, NEAR)
        if not max(right - left, bottom - top) <= _WIDEST * max(self._width, self._height):
            return None
        x0, y0 = math.ceil(left), math.ceil(top)
        shape = (max(math.floor(bottom) - y0 + 1, 0), max(math.floor(right) - x0 + 1, 0), 1)
        canvas, ids = np.zeros(shape, np.float32), np.empty(shape, np.int32)
        if canvas.size:
            rasterise(
                hom, surface.faces, surface.closed, NEAR, (x0, y0), CENTRE_SAMPLE, canvas, ids, 0
            )
        return _Layer(canvas[..., 0], x0, y0, int(np.count_nonzero(canvas)))


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
