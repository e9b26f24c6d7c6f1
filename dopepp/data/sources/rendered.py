"""Virtual images as a source: every item is rendered when it is asked for.

Training, validation and test are three disjoint index ranges of one factory, so no image is ever in
two of them. Only training images change with the epoch.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np

from dopepp.data.sample import Instance, Sample, SourceInfo
from dopepp.virtual.factory import Factory
from dopepp.virtual.scene import Rendered

Split = Literal["train", "val", "test"]

MAX_ITEMS: Final = 1_000_000_000
FIRST_INDEX: Final[dict[Split, int]] = {"train": 0, "val": MAX_ITEMS, "test": 2 * MAX_ITEMS}
"""First factory index of each split; no split may hold more than ``MAX_ITEMS`` items."""


class RenderedSource:
    """A range of a factory's images.

    Args:
        split: Which of the three disjoint index ranges; ``val`` and ``test`` ignore the epoch.
        scale: How many times as large the parts appear: the camera of the same scenes, moved (see
            :mod:`dopepp.virtual.arrange.random_scene`).

    Raises:
        ValueError: ``num_items`` is not in 1 … 10⁹, or ``scale`` is not positive and finite.
    """

    def __init__(
        self,
        factory: Factory,
        num_items: int,
        split: Split = "train",
        name: str = "virtual",
        scale: float = 1.0,
    ) -> None:
        if not 1 <= num_items <= MAX_ITEMS:
            raise ValueError(f"num_items must be in 1 … {MAX_ITEMS}, got {num_items}")
        if not 0 < scale < math.inf:
            raise ValueError(f"scale must be positive and finite, got {scale}")
        self.factory, self.split, self.name, self.scale = factory, split, name, scale
        self._num_items = num_items

    def __len__(self) -> int:
        return self._num_items

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Render item ``index``."""
        if not 0 <= index < self._num_items:
            raise IndexError(f"item {index} of {self._num_items}")
        epoch = epoch if self.split == "train" else 0
        rendered = self.factory.render(epoch, FIRST_INDEX[self.split] + index, self.scale)
        return rendered_sample(rendered, self.name, f"{self.split}/{epoch}/{index}")

    def contains(self, label: str) -> bool:
        """Tell whether the factory renders this object."""
        return any(part.name == label for part in self.factory.parts)

    def describe(self) -> list[SourceInfo]:
        """Return the range, the factory's settings and the parts' hashes."""
        identity: dict[str, object] = {
            "split": self.split,
            "seed": self.factory.seed,
            "preset": repr(self.factory.preset),
            "backgrounds": self.factory.backgrounds.identity(),
            "renderer": self.factory.renderer,
            "parts": {part.name: part.mesh_hash for part in self.factory.parts},
            "negatives": {part.name: part.mesh_hash for part in self.factory.negatives},
        }
        if self.scale != 1:  # what was rendered before there were scales keeps its identity
            identity["scale"] = self.scale
        return [SourceInfo(self.name, self._num_items, identity)]


def rendered_sample(rendered: Rendered, source: str, key: str) -> Sample:
    """Turn a rendered image into a sample; distractors are no instances.

    A target of which no pixel is visible stays an instance with visible fraction 0.
    """
    scene = rendered.scene
    instances = [
        Instance(
            label=scene.objects[number].label,
            T_cam_obj=np.asarray(scene.objects[number].T_cam_obj, np.float64),
            keypoints=scene.keypoints(number),
            visible_fraction=float(rendered.visible_fractions[number]),
            mask=rendered.instances == number,
        )
        for number in scene.targets
    ]
    return Sample(rendered.image, scene.K, instances, rendered.depth, source, key)
