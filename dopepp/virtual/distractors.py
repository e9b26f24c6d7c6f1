"""What stands around the targets: primitives, and other parts that only look like them.

To add a shape, add it to :mod:`dopepp.virtual.shapes`; to add a part that must not be mistaken for
a target, give it to the factory as a negative.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from dopepp.virtual.body import Body
from dopepp.virtual.ranges import check_counts, check_number, check_range
from dopepp.virtual.shapes import distractor_shapes

_SMALLEST_STRETCH: Final = 0.5
"""A primitive's axes are stretched by 0.5 to 1 of its size each, so none looks like another."""


@dataclass(frozen=True)
class Distractors:
    """Random objects around the targets.

    Attributes:
        number: Smallest and largest number per image; one that would hide a target too much or
            finds no place is left out.
        image_share: Smallest and largest diameter of a primitive's image over the image's width.
        depth: Smallest and largest depth in units of the first target's depth; of no use on a
            plane, which gives the depth.
        lookalike_share: Chance that a distractor is a negative: another weakly textured part,
            where there is one.
        lookalike_scale: Size of a negative over its real size.
    """

    number: tuple[int, int] = (0, 2)
    image_share: tuple[float, float] = (0.12, 0.5)
    depth: tuple[float, float] = (0.6, 1.6)
    lookalike_share: float = 0.3
    lookalike_scale: tuple[float, float] = (0.7, 1.3)

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_counts(self, "number", 0, 100)
        check_range(self, "image_share", 1e-3, 10.0, "image widths")
        check_range(self, "depth", 0.01, 100.0, "depths of the first target")
        check_number(self, "lookalike_share", 0.0, 1.0, "share")
        check_range(self, "lookalike_scale", 0.01, 100.0, "factor")

    def draw(
        self, rng: np.random.Generator, width_at_depth: float, negatives: Sequence[Body]
    ) -> Body:
        """Draw a distractor.

        Args:
            rng: Source of randomness.
            width_at_depth: What the image's width shows at the distractor's depth, metres.
            negatives: Other parts.
        """
        if rng.random() < self.lookalike_share and negatives:
            negative = negatives[int(rng.integers(len(negatives)))]
            return negative.stretched(np.full(3, rng.uniform(*self.lookalike_scale)))
        shapes = distractor_shapes()
        radius = 0.5 * rng.uniform(*self.image_share) * width_at_depth
        shape = shapes[int(rng.integers(len(shapes)))]
        return shape.stretched(radius * rng.uniform(_SMALLEST_STRETCH, 1.0, 3))
