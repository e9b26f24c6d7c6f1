"""What lies behind the scene: photos of a folder, scikit-image's photos, or procedural textures.

To add a kind, write a class with the methods of :class:`Backgrounds` and name it in
:func:`find_backgrounds`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from numpy.random import Generator

from dopepp.drawing.pictures import Picture
from dopepp.virtual.backgrounds.photos import PhotoBackgrounds, bundled_photos
from dopepp.virtual.backgrounds.procedural import ProceduralBackgrounds

__all__ = ["Backgrounds", "PhotoBackgrounds", "ProceduralBackgrounds", "find_backgrounds"]


class Backgrounds(Protocol):
    """Draws background images."""

    def draw(self, rng: Generator, width: int, height: int) -> Picture:
        """Return an RGB image of the asked size, a pure function of the generator's state."""

    def identity(self) -> list[str]:
        """Return the kind and a fingerprint of its files, for the record of what was rendered."""


def find_backgrounds(choice: str | Path | None) -> Backgrounds:
    """Return the backgrounds that a user names.

    ``choice`` is None or ``procedural``, the same on every machine; ``skimage`` for the photos in
    an installed scikit-image; or a folder of photos (``./skimage`` for one of that name).

    Raises:
        UserError: The folder is missing or holds no photo, or scikit-image is not installed.
    """
    if choice is None or choice == "procedural":
        return ProceduralBackgrounds()
    if choice == "skimage":
        return bundled_photos()
    return PhotoBackgrounds(Path(choice))
