"""The factory: image ``(epoch, index)`` of an endless, reproducible supply."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.parts.catalogue import BUILTIN
from dopepp.parts.part import Part
from dopepp.virtual.arrange.random_scene import random_scene
from dopepp.virtual.backgrounds import Backgrounds, ProceduralBackgrounds
from dopepp.virtual.body import make_body
from dopepp.virtual.presets.preset import Preset
from dopepp.virtual.renderers import find_renderer
from dopepp.virtual.scene import Rendered, Scene
from dopepp.virtual.sensor import capture

_PACKAGE: Final = Path(__file__).parents[1]
_FOLDERS: Final = ("virtual", "parts", "geometry")
"""The packages that decide a render's pixels and labels."""


class Factory:
    """Renders labelled images of parts; image (epoch, index) depends on nothing but the seed.

    A factory can be pickled and forked: it holds no generator, so any process renders the same
    bytes for the same (seed, epoch, index), in any order. Backgrounds are procedural if not given.
    ``negatives`` are parts that are shown among the distractors, so that a network learns not to
    find them; the built-in parts that are no targets are always among them.

    Raises:
        UserError: There is no part, a part has no mesh, two share a name, a negative is a target
            (by name or mesh), or the seed is negative.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        preset: Preset,
        seed: int,
        backgrounds: Backgrounds | None = None,
        renderer: str = "raster",
        negatives: Sequence[Part] = (),
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
        self.negatives = _all_negatives(parts, negatives)
        self.backgrounds = ProceduralBackgrounds() if backgrounds is None else backgrounds
        self.renderer, self._render = renderer, find_renderer(renderer)
        self._targets = [make_body(part, is_target=True) for part in parts]
        self._others = [make_body(part, is_target=False) for part in self.negatives]

    def scene(self, epoch: int, index: int, scale: float = 1.0) -> Scene:
        """Return the scene of an image without rendering it; see :func:`random_scene`."""
        rng = np.random.default_rng([self.seed, epoch, index])
        return random_scene(self.preset, self._targets, self._others, rng, self.backgrounds, scale)

    def render(self, epoch: int, index: int, scale: float = 1.0) -> Rendered:
        """Render an image with its ground truth, as the scene's sensor takes it.

        ``scale`` is how many times as large its parts appear: the camera of the same scene, moved
        (see :mod:`dopepp.virtual.arrange.random_scene`). A UserError, where the preset cannot show
        the part, or the camera cannot stand there.
        """
        rendered = self._render(self.scene(epoch, index, scale))
        return replace(rendered, image=capture(rendered.image, rendered.scene.sensor))


@cache
def code_hash() -> str:
    """Return a SHA-256 of the rendering code: kept renders of other code are not reused.

    Two versions of it may draw the same scene differently.
    """
    digest = hashlib.sha256()
    for folder in _FOLDERS:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            digest.update(f"{path.relative_to(_PACKAGE).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _all_negatives(parts: Sequence[Part], given: Sequence[Part]) -> tuple[Part, ...]:
    """Return the given negatives and the built-in parts that are neither targets nor given."""
    names, hashes = {part.name for part in parts}, {part.mesh_hash for part in parts}
    for part in given:
        if part.name in names or part.mesh_hash in hashes:
            raise UserError(
                f"negative {part.name}, which is one of the targets {', '.join(sorted(names))}",
                "parts of other names and other meshes than the targets'",
                "take it out of the negatives",
            )
    known = names | {part.name for part in given}
    hashes |= {part.mesh_hash for part in given}
    built_in = (make() for make in BUILTIN.values())
    others = [p for p in built_in if p.name not in known and p.mesh_hash not in hashes]
    return (*given, *others)
