"""Clutter: backgrounds that are full of things, as desks and workshops are.

Photos of landscapes and people have few sharp outlines of the size of a part. A network that has
seen its part before such photos alone takes much of a real desk for it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from dopepp.drawing.pictures import Picture

if TYPE_CHECKING:
    from dopepp.virtual.backgrounds import Backgrounds

_PLAIN_SHARE: Final = 0.4
"""Share of the pieces that have one colour, lighter towards one side, as weakly textured things."""

_PRINTED_SHARE: Final = 0.2
"""Share of those that have cells of a dark and a light colour, as markers and keyboards; the others
are cut out of backgrounds."""

_WIDTHS: Final = (0.04, 0.4)
"""Of a piece, over the picture's width; logarithmically uniform: most things are small."""

_FINE_BITS: Final = 4
"""Outlines are drawn in sixteenths of a pixel."""


class ClutteredBackgrounds:
    """Backgrounds with pieces of others on them: polygons, turned boxes, ellipses and rings.

    Args:
        behind: What lies behind, and what some of the pieces are cut out of.
        number: Smallest and largest number of pieces.
        contrast: Smallest and largest factor on the whole picture's contrast, about its mean.
    """

    def __init__(
        self,
        behind: Backgrounds,
        number: tuple[int, int],
        contrast: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        self.behind, self.number, self.contrast = behind, number, contrast

    def identity(self) -> list[str]:
        """Return what lies behind, the number of pieces and the contrast."""
        return [*self.behind.identity(), "cluttered", *map(str, (*self.number, *self.contrast))]

    def draw(self, rng: Generator, width: int, height: int) -> Picture:
        """Return a background with pieces on it."""
        image = self.behind.draw(rng, width, height).copy()
        for _ in range(int(rng.integers(self.number[0], self.number[1] + 1))):
            self._add_piece(rng, image)
        if self.contrast == (1.0, 1.0):
            return image
        factor = rng.uniform(*self.contrast)
        image = image * np.float32(factor) + np.float32((1 - factor) * image.mean())
        return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)

    def _add_piece(self, rng: Generator, image: Picture) -> None:
        """Lay a piece on a picture; what of it is beyond the border is cut off."""
        rows, columns = image.shape[:2]
        size = columns * math.exp(rng.uniform(*np.log(_WIDTHS)))
        outline = _outline(rng) * size / 2
        # What does not lie on the picture need not be drawn.
        corner = np.floor(rng.uniform(0, 1, 2) * (columns, rows) - size / 2).astype(int)
        first, last = np.maximum(corner, 0), np.minimum(corner + math.ceil(size), (columns, rows))
        if (last - first < 2).any():
            return
        wide, high = (int(one) for one in last - first)
        mask = np.zeros((high, wide), np.uint8)
        points = np.round((outline + corner + size / 2 - first) * 2**_FINE_BITS).astype(np.int32)
        cv2.fillPoly(mask, [*points], 255, cv2.LINE_AA, _FINE_BITS)
        kind = rng.random()
        others = _printed if kind < _PLAIN_SHARE + _PRINTED_SHARE else self.behind.draw
        draw = _plain if kind < _PLAIN_SHARE else others
        piece = draw(rng, wide, high).astype(np.float32)
        there = image[first[1] : last[1], first[0] : last[0]]
        opacity = np.repeat(mask[..., None], 3, axis=2).astype(np.float32) / 255
        there[:] = np.rint(there + opacity * (piece - there))


def _outline(rng: Generator) -> Float[np.ndarray, "loops points 2"]:
    """Return one closed line or two, one inside the other, within the unit circle."""
    kind = int(rng.integers(4))
    corners = (int(rng.integers(3, 9)), 4, 32, 32)[kind]
    angles = np.arange(corners) / corners * 2 * np.pi
    radii = rng.uniform(0.4, 1.0, corners) if kind == 0 else np.ones(corners)
    loop = radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    turn, flat = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 1.0)
    cosine, sine = np.cos(turn), np.sin(turn)
    loop = loop * (1.0, flat) @ np.array([[cosine, sine], [-sine, cosine]])
    inner = rng.uniform(0.4, 0.9)
    return np.stack([loop, inner * loop]) if kind == 3 else loop[None]


def _plain(rng: Generator, width: int, height: int) -> Picture:
    """Return one colour, lighter towards one side."""
    colour = rng.uniform(0, 255, 3)
    grey = colour.mean()
    colour = grey + rng.uniform(0, 1) * (colour - grey)
    direction = rng.uniform(-0.5, 0.5, 2)
    x, y = np.linspace(-1, 1, width)[None, :, None], np.linspace(-1, 1, height)[:, None, None]
    light = 1 + direction[0] * x + direction[1] * y
    return np.asarray(np.clip(colour * light, 0, 255), np.uint8)


def _printed(rng: Generator, width: int, height: int) -> Picture:
    """Return cells of one dark and one light colour, turned."""
    columns, rows = rng.integers(1, 9, 2)
    dark, light = rng.uniform((0, 140), (90, 255))
    cells = np.where(rng.random((rows, columns, 1)) < 0.5, dark, light) * rng.uniform(0.8, 1.2, 3)
    codes = np.asarray(np.clip(cells, 0, 255), np.uint8)
    upright = cv2.resize(codes, (width, height), interpolation=cv2.INTER_NEAREST)
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), rng.uniform(0, 360), 1.0)
    image = cv2.warpAffine(upright, turn, (width, height), borderMode=cv2.BORDER_WRAP)
    return np.asarray(image, np.uint8)
