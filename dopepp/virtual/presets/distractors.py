"""What stands around the targets: primitives, profiles, and other parts that only look like them.

To add a shape, yield it from ``_solids`` or ``_profiles``; to add a part that must not be mistaken
for a target, give it to the factory as a negative.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.random import Generator

from dopepp.core.validation import Checked, Pair, Share, Span
from dopepp.parts.part import Mesh
from dopepp.virtual.body import Body
from dopepp.virtual.surface import Surface, make_surface


@dataclass(frozen=True)
class Distractors(Checked):
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

    number: Annotated[tuple[int, int], Span(0, 100, "a count")] = (0, 2)
    image_share: Annotated[Pair, Span(1e-3, 10.0, "image widths")] = (0.12, 0.5)
    depth: Annotated[Pair, Span(0.01, 100.0, "depths of the first target")] = (0.6, 1.6)
    lookalike_share: Share = 0.3
    lookalike_scale: Annotated[Pair, Span(0.01, 100.0, "factor")] = (0.7, 1.3)

    def draw(self, rng: Generator, width_at_depth: float, negatives: Sequence[Body]) -> Body:
        """Draw a distractor for a depth at which the image's width shows so many metres."""
        if rng.random() < self.lookalike_share and negatives:
            negative = negatives[int(rng.integers(len(negatives)))]
            return negative.stretched(np.full(3, rng.uniform(*self.lookalike_scale)))
        shapes = distractor_shapes()
        radius = 0.5 * rng.uniform(*self.image_share) * width_at_depth
        shape = shapes[int(rng.integers(len(shapes)))]
        # Stretched by another factor along each axis, none looks like another.
        return shape.stretched(radius * rng.uniform(0.5, 1.0, 3))


@cache
def distractor_shapes() -> tuple[Body, ...]:
    """Return the library of shapes; each is centred and has a bounding sphere of radius 1."""
    return tuple(Body(_unit_surface(solid)) for solid in _solids())


def _solids() -> Iterator[Manifold]:
    """Yield solids of any size and place."""
    yield Manifold.cube((1.0, 0.7, 0.5))
    yield Manifold.cube((1.0, 0.9, 0.15))
    yield Manifold.cylinder(1.0, 0.35, circular_segments=48)
    yield Manifold.cylinder(0.15, 0.6, circular_segments=48)
    yield Manifold.cylinder(1.0, 0.5, 0.2, circular_segments=48)
    yield Manifold.sphere(0.5, 32)
    for profile, thickness in _profiles():
        yield profile.extrude(thickness)


def _profiles() -> Iterator[tuple[CrossSection, float]]:
    """Yield plates with holes and extruded profiles: what lies about in a workshop."""

    def box(width: float, height: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
        return CrossSection.square((width, height), center=True).translate((x, y))

    def disc(radius: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
        return CrossSection.circle(radius, 32).translate((x, y))

    yield box(1.0, 0.6) - disc(0.1, -0.35, 0.15) - disc(0.1, 0.35, -0.15), 0.08
    yield box(1.0, 0.5) - disc(0.16) - box(0.2, 0.06, 0.35) - disc(0.05, -0.4, 0.15), 0.06
    yield disc(0.5) - disc(0.3), 0.2
    yield disc(0.5) - disc(0.12) - disc(0.08, 0.3) - disc(0.08, -0.15, 0.26), 0.1
    yield CrossSection.circle(0.5, 6) - disc(0.28), 0.4
    yield box(1.0, 0.2, 0.0, -0.4) + box(0.2, 1.0, -0.4), 0.5
    yield box(1.0, 1.0) - box(0.7, 0.85, 0.0, 0.15), 0.4
    yield box(1.0, 0.25) + box(0.25, 1.0), 0.15


def _unit_surface(solid: Manifold) -> Surface:
    """Centre a solid, scale its bounding sphere to radius 1 and prepare it."""
    mesh = solid.to_mesh()
    vertices = np.asarray(mesh.vert_properties, np.float64)[:, :3]
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices /= np.linalg.norm(vertices, axis=1).max()
    return make_surface(Mesh(vertices, np.asarray(mesh.tri_verts, np.int32)))
