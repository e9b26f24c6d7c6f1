"""Backgrounds: photos of a folder, photos of scikit-image, or procedural textures.

To add a kind, write a class with the methods of :class:`Backgrounds` and name it in
:func:`find_backgrounds`.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Final, Literal, Protocol

from numpy.random import Generator

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import RGBImage
from dopepp.virtual.backgrounds.photo_backgrounds import PhotoBackgrounds, PhotoSplit
from dopepp.virtual.backgrounds.procedural import ProceduralBackgrounds

__all__ = [
    "Backgrounds",
    "MixedBackgrounds",
    "PhotoBackgrounds",
    "ProceduralBackgrounds",
    "find_backgrounds",
    "shipped_photos",
]

BUNDLED: Final = (
    "astronaut.png", "brick.png", "camera.png", "chelsea.png", "coffee.png", "coins.png",
    "grass.png", "gravel.png", "motorcycle_left.png", "motorcycle_right.png", "rocket.jpg",
)  # fmt: skip
"""Photos in scikit-image's wheel; its other images are drawings, scans and microscopy."""

_SHIPPED: Final = Path(__file__).parent / "photos"


class Backgrounds(Protocol):
    """Source of random background images."""

    def draw(self, rng: Generator, width: int, height: int) -> RGBImage:
        """Return an RGB image that depends only on the arguments."""

    def identity(self) -> list[str]:
        """Return the backgrounds' kind and a fingerprint of their files, for records of renders."""


def find_backgrounds(choice: str | Path | None, split: PhotoSplit = "all") -> Backgrounds:
    """Return the backgrounds that a user selects, or one ``split`` of the photos.

    A choice is None or ``procedural`` for textures, which need no files; ``skimage`` for the photos
    in scikit-image; or a folder of photos (``./skimage`` for a folder of that name).

    Raises:
        UserError: The folder is missing or contains no photo, or scikit-image is not installed.
    """
    if choice is None or choice == "procedural":
        return ProceduralBackgrounds()
    photos = bundled_photos() if choice == "skimage" else PhotoBackgrounds(Path(choice))
    return photos.part(split)


class MixedBackgrounds:
    """Backgrounds from two sources: ``other`` with probability ``share``, else ``usual``."""

    def __init__(self, usual: Backgrounds, other: Backgrounds, share: float) -> None:
        self.usual, self.other, self.share = usual, other, share

    def identity(self) -> list[str]:
        """Return the identities of both sources, and the share."""
        return [*self.usual.identity(), f"mixed {self.share:g}", *self.other.identity()]

    def draw(self, rng: Generator, width: int, height: int) -> RGBImage:
        """Sample a background from one of the two sources."""
        chosen = self.other if rng.random() < self.share else self.usual
        return chosen.draw(rng, width, height)


def shipped_photos(split: Literal["val", "test"]) -> PhotoBackgrounds:
    """Return the validation or test half of this package's photos, which training never uses."""
    return PhotoBackgrounds(_SHIPPED).part(split, held_out=0.5)


def bundled_photos() -> PhotoBackgrounds:
    """Return the photos in an installed scikit-image; nothing is downloaded or imported.

    Raises:
        UserError: scikit-image or its photos are not installed.
    """
    package = importlib.util.find_spec("skimage")
    folder = Path(package.origin).parent / "data" if package and package.origin else None
    names = [name for name in BUNDLED if folder and (folder / name).is_file()]
    if folder is None or not names:
        problem = "backgrounds=skimage without scikit-image and its photos"
        fix = "pip install scikit-image, or pass a folder of photos"
        raise UserError(problem, "an installed scikit-image", fix)
    return PhotoBackgrounds(folder, names)
