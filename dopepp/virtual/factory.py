"""The factory: image ``(epoch, index)`` of an endless, reproducible supply."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dopepp.errors import UserError
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import Backgrounds, ProceduralBackgrounds
from dopepp.virtual.presets import Preset
from dopepp.virtual.randomise import random_scene
from dopepp.virtual.renderers import find_renderer
from dopepp.virtual.scene import Rendered, Scene
from dopepp.virtual.surface import make_surface


class Factory:
    """Renders labelled images of parts; image (epoch, index) depends on nothing but the seed.

    A factory can be pickled and forked: it holds no generator, so any process renders the same
    bytes for the same (seed, epoch, index), in any order.

    Args:
        parts: The parts to show, with their meshes.
        preset: The distribution of scenes.
        seed: Non-negative seed of the whole supply.
        backgrounds: Where backgrounds come from; procedural ones if not given.
        renderer: Key of :data:`~dopepp.virtual.renderers.RENDERERS`.

    Raises:
        UserError: There is no part, a part has no mesh, two share a name, or the seed is negative.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        preset: Preset,
        seed: int,
        backgrounds: Backgrounds | None = None,
        renderer: str = "raster",
    ) -> None:
        names = [part.name for part in parts]
        if not parts or len(set(names)) != len(names):
            raise UserError(
                f"parts {names} to render", "at least one part, each with a name of its own",
                "name the parts differently",
            )  # fmt: skip
        if seed < 0:
            raise UserError(f"seed {seed}", "an integer >= 0", "choose another seed")
        self.parts, self.preset, self.seed = tuple(parts), preset, seed
        self.backgrounds = ProceduralBackgrounds() if backgrounds is None else backgrounds
        self.renderer, self._render = renderer, find_renderer(renderer)
        self._surfaces = {}
        for part in parts:
            if part.mesh is None:
                raise UserError(
                    f"part {part.name} without a mesh",
                    "parts that were read from a mesh file or built in",
                    "give the part's mesh file; a checkpoint's objects table holds no mesh",
                )
            self._surfaces[part.name] = make_surface(part.mesh)

    def scene(self, epoch: int, index: int) -> Scene:
        """Return the scene of an image without rendering it."""
        rng = np.random.default_rng([self.seed, epoch, index])
        return random_scene(self.preset, self.parts, rng, self._surfaces, self.backgrounds)

    def render(self, epoch: int, index: int) -> Rendered:
        """Render an image with its ground truth.

        Raises:
            UserError: The preset cannot show the part (see :func:`random_scene`).
        """
        return self._render(self.scene(epoch, index))
