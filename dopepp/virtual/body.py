"""A body: what can be put into a scene, and how it can lie there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from dopepp.errors import UserError
from dopepp.parts.part import Part
from dopepp.virtual.resting import Hull, make_hull
from dopepp.virtual.surface import Surface, make_surface


@dataclass(frozen=True, eq=False)
class Body:
    """A surface that can be posed.

    Attributes:
        surface: Its geometry.
        part: The part it is; None for what no network is to find.
        source: The body it was stretched from.
        stretch: By how much, along x, y and z.
    """

    surface: Surface
    part: Part | None = None
    source: Body | None = None
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @cached_property
    def hull(self) -> Hull:
        """Its convex hull; that of a stretched body is stretched, not computed again."""
        if self.source is not None:
            return self.source.hull.scaled(np.array(self.stretch))
        return make_hull(self.surface)

    def stretched(self, scale: Float[np.ndarray, "3"]) -> Body:
        """Return a body of no part, stretched along its axes by positive factors."""
        x, y, z = (float(factor) for factor in scale)
        return Body(self.surface.scaled(np.array((x, y, z))), source=self, stretch=(x, y, z))


def make_body(part: Part, *, is_target: bool) -> Body:
    """Prepare a part's mesh.

    Args:
        part: With its mesh.
        is_target: Whether the network is to find it.

    Raises:
        UserError: The part has no mesh, or one that cannot be rendered.
    """
    if part.mesh is None:
        raise UserError(
            f"part {part.name} without a mesh",
            "parts that were read from a mesh file or built in",
            "give the part's mesh file; a checkpoint's objects table holds no mesh",
        )
    return Body(make_surface(part.mesh), part if is_target else None)
