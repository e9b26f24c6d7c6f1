"""The distractors' shapes: primitives and perforated profiles of about unit size."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
from manifold3d import CrossSection, Manifold

from dopepp.parts.part import Mesh
from dopepp.virtual.body import Body
from dopepp.virtual.surface import Surface, make_surface


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
