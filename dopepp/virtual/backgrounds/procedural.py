"""Procedural backgrounds: textures with shapes, and clutter.

Photos of landscapes and people have few sharp outlines of the size of a part. A network trained on
these photos alone falsely detects the part all over a real desk; clutter therefore adds pieces of
other images. To add a pattern, write a function like ``_checker`` and name it in ``_PATTERNS``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8
from numpy.random import Generator

from dopepp.core.validation import Pair
from dopepp.drawing.pictures import RGBImage

if TYPE_CHECKING:
    from dopepp.virtual.backgrounds import Backgrounds

Field = Float32[np.ndarray, "height width"]

_SHARP_WIDTH_PX: Final = 256  # textures up to this width are drawn at full resolution


class ProceduralBackgrounds:
    """Textures made from noise, gradients, tiles, bricks, wood and scattered shapes."""

    def identity(self) -> list[str]:
        """Return the kind; procedural backgrounds have no files to identify."""
        return ["procedural"]

    def draw(self, rng: Generator, width: int, height: int) -> RGBImage:
        """Return one texture, or two blended by smooth noise, with 0 to 12 random shapes on top."""
        image = _texture(rng, width, height)
        if rng.random() < 0.4:
            columns, rows = max(width // 8, 1), max(height // 8, 1)
            coarse = np.clip(_noise(rng, columns, rows, 2) * np.float32(3) - 1, 0, 1)
            weight = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
            other = _texture(rng, width, height)
            image = cv2.blendLinear(image, other, weight, 1 - weight)
        _scatter(rng, image, int(rng.integers(0, 13)))
        return np.asarray(image, np.uint8)


def _texture(rng: Generator, width: int, height: int) -> RGBImage:
    """Return a random pattern, coloured by a random :func:`_palette`."""
    pattern = _PATTERNS[int(rng.integers(len(_PATTERNS)))]
    scale = 1.0
    # Large backgrounds are drawn coarser and enlarged, because backgrounds are out of focus.
    if width > _SHARP_WIDTH_PX:
        scale = max(rng.uniform(0.35, 0.75), _SHARP_WIDTH_PX / width)
    columns, rows = round(width * scale), max(round(height * scale), 1)
    field = pattern(rng, columns, rows)
    grain = np.float32(rng.uniform(0.0, 0.25))
    field = (1 - grain) * field + grain * _noise(rng, columns, rows, int(rng.integers(16, 64)))
    codes = np.clip(field * 255, 0, 255).astype(np.uint8)
    if scale < 1.0:
        codes = np.asarray(cv2.resize(codes, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.asarray(cv2.applyColorMap(codes, _palette(rng)), np.uint8)


def _palette(rng: Generator) -> UInt8[np.ndarray, "256 1 3"]:
    """Return a colour map that interpolates two to five random colours, mostly muted."""
    count = int(rng.integers(2, 6))
    colours = rng.uniform(0, 255, (count, 3))
    if rng.random() < 0.5:
        colours = rng.uniform(20, 235, 3) + (colours - 127) * rng.uniform(0.1, 0.5)
    # Rooms and workshops are greyer than random colours: pull most palettes towards grey.
    grey = colours.mean(axis=1, keepdims=True)
    colours = grey + (colours - grey) * rng.uniform(0.0, 1.0)
    # Interpolate linearly from the first colour at code 0 to the last at 255.
    position = np.arange(256) * ((count - 1) / 255)
    before = np.minimum(position.astype(np.int64), count - 2)
    share = (position - before)[:, None]
    colours = (1 - share) * colours[before] + share * colours[before + 1]
    return np.asarray(np.clip(colours, 0, 255), np.uint8)[:, None]


def _noise(rng: Generator, width: int, height: int, cells: int) -> Field:
    """Return smooth noise in [0, 1] with ``cells`` lattice cells along the image's width."""
    rows = max(round(cells * height / width), 1)
    grid = rng.random((rows + 1, cells + 1), np.float32)
    if cells * 32 <= width:
        # Large cells are smooth enough to be drawn at a quarter of the resolution.
        quarter = (width // 4, max(height // 4, 1))
        grid = np.asarray(cv2.resize(grid, quarter, interpolation=cv2.INTER_CUBIC))
        return np.asarray(cv2.resize(grid, (width, height), interpolation=cv2.INTER_LINEAR))
    # Linear interpolation shows creases in large cells only.
    smooth = cv2.INTER_CUBIC if cells * 8 <= width else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(grid, (width, height), interpolation=smooth))


def _clouds(rng: Generator, width: int, height: int) -> Field:
    """Return noise summed over up to five octaves; the weight falls by a random factor in each."""
    field = np.zeros((height, width), np.float32)
    total, cells, gain = 0.0, int(rng.integers(2, 8)), rng.uniform(0.4, 0.9)
    for octave in range(5):
        if octave > 0 and cells * 2**octave > width:
            break
        cv2.scaleAdd(_noise(rng, width, height, cells * 2**octave), gain**octave, field, field)
        total += gain**octave
    # Sums of noise concentrate around their mean, so they are stretched over the palette.
    return np.asarray((field / total - 0.5) * 1.8 + 0.5)


def _coordinates(rng: Generator, width: int, height: int) -> tuple[Field, Field]:
    """Return pixel coordinates, rotated, bent and in perspective, in units of about the width."""
    angle, bend = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.08)
    x = np.linspace(-0.5, 0.5, width, dtype=np.float32)[None]
    y = (np.linspace(-0.5, 0.5, height, dtype=np.float32) * (height / width))[:, None]
    depth = 1 + np.float32(rng.uniform(-0.8, 0.8)) * x + np.float32(rng.uniform(-0.8, 0.8)) * y
    cosine, sine = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    near = 1 / depth
    along, across = (cosine * x - sine * y) * near, (sine * x + cosine * y) * near
    if rng.random() < 0.5:
        along = along + np.float32(bend) * _noise(rng, width, height, 4)
    return along, across


def _gradient(rng: Generator, width: int, height: int) -> Field:
    """Return a gradient that is linear along one direction and quadratic across it."""
    along, across = _coordinates(rng, width, height)
    return np.asarray(along * np.float32(rng.uniform(0.5, 1.5)) + across * across + 0.5)


def _checker(rng: Generator, width: int, height: int) -> Field:
    """Return a checkerboard of two grey levels."""
    along, across = _coordinates(rng, width, height)
    tiles = np.float32(rng.uniform(2, 16))
    odd = _whole(along * tiles) + _whole(across * tiles) & 1
    return np.asarray(np.array([0.2, 0.8], np.float32)[odd])


def _whole(values: Field) -> Int32[np.ndarray, "height width"]:
    """Round down to int32, whose remainders are fast to compute."""
    return np.asarray(np.floor(values), np.int32)


def _bricks(rng: Generator, width: int, height: int) -> Field:
    """Return rows of bricks, offset by half a brick, with mortar joints and random shades."""
    along, across = _coordinates(rng, width, height)
    across = across * np.float32(rng.uniform(4, 14))
    row = _whole(across)
    along = along * np.float32(rng.uniform(2, 6)) + (row & 1) * np.float32(0.5)
    column = _whole(along)
    joint = np.float32(rng.uniform(0.03, 0.15))
    mortar = (along - column < joint) | (across - row < 2 * joint)
    shades = np.float32(0.3) + np.float32(0.5) * rng.random(256, np.float32)
    shade = shades[(row * np.int32(17) + column * np.int32(31)).astype(np.uint8)]
    return np.where(mortar, np.float32(rng.random()), shade)


def _wood(rng: Generator, width: int, height: int) -> Field:
    """Return wood grain: bent stripes (the growth rings of a board) with fibres."""
    along, across = _coordinates(rng, width, height)
    rings = across * np.float32(rng.uniform(6, 30)) + 2 * _noise(rng, width, height, 3)
    rings += np.float32(rng.uniform(0, 4)) * along * along
    fibres = rng.random((max(height // 2, 1), max(width // 32, 1)), np.float32)
    fibre = cv2.resize(fibres, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(0.7 * (rings - np.floor(rings)) + 0.3 * fibre)


def _speckle(rng: Generator, width: int, height: int) -> Field:
    """Return fine noise over coarse noise: concrete, carpet, terrazzo."""
    cells = max(int(rng.integers(width // 4, width // 2 + 1)), 1)
    share = np.float32(rng.uniform(0.2, 0.7))
    return share * _noise(rng, width, height, cells) + (1 - share) * _clouds(rng, width, height)


_Pattern = Callable[[Generator, int, int], Field]
_PATTERNS: Final[Sequence[_Pattern]] = (_clouds, _gradient, _checker, _bricks, _wood, _speckle)


def _scatter(rng: Generator, image: RGBImage, count: int) -> None:
    """Draw random ellipses, polygons, lines and circles over an image in place."""
    height, width = image.shape[:2]
    # Sample all numbers at once; single draws would take longer than the shapes.
    for red, green, blue, x, y, size, kind, turn, more in rng.random((count, 9)).tolist():
        colour = (256 * red, 256 * green, 256 * blue)
        centre = (int(x * width), int(y * height))
        radius = int(width * (0.02 + 0.18 * size)) + 1
        thickness = 1 + int(more * max(width // 40 - 1, 1))
        if kind < 0.25:
            axes = (radius, int(radius * (0.3 + 0.7 * more)) + 1)
            cv2.ellipse(image, centre, axes, 180 * turn, 0, 360, colour, -1, cv2.LINE_AA)
        elif kind < 0.5:
            angles = np.sort(rng.uniform(0, 2 * np.pi, 3 + int(4 * more)))
            outline = centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
            cv2.fillPoly(image, [outline.astype(np.int32)], colour, cv2.LINE_AA)
        elif kind < 0.75:
            end = (int(turn * width), int(size * height))
            cv2.line(image, centre, end, colour, thickness, cv2.LINE_AA)
        else:
            cv2.circle(image, centre, radius, colour, thickness, cv2.LINE_AA)


_PLAIN_SHARE: Final = 0.4  # share of pieces of one colour with a brightness gradient
_PRINTED_SHARE: Final = 0.2  # share of pieces with dark and light cells, like markers
_WIDTHS: Final = (0.04, 0.4)  # a piece's width in image widths, log-uniform
_FINE_BITS: Final = 4  # outlines are drawn in sixteenths of a pixel


class ClutteredBackgrounds:
    """Backgrounds with pieces of other images: polygons, rotated boxes, ellipses and rings.

    Some pieces are cut from ``behind``. ``number`` limits the number of pieces, and ``contrast``
    the factor on the whole image's contrast, about its mean.
    """

    def __init__(
        self, behind: Backgrounds, number: tuple[int, int], contrast: Pair = (1.0, 1.0)
    ) -> None:
        self.behind, self.number, self.contrast = behind, number, contrast

    def identity(self) -> list[str]:
        """Return the identity of ``behind``, and the limits of the number and the contrast."""
        return [*self.behind.identity(), "cluttered", *map(str, (*self.number, *self.contrast))]

    def draw(self, rng: Generator, width: int, height: int) -> RGBImage:
        """Return a background with pieces of other images, at a random contrast."""
        image = self.behind.draw(rng, width, height).copy()
        for _ in range(int(rng.integers(self.number[0], self.number[1] + 1))):
            self._add_piece(rng, image)
        if self.contrast == (1.0, 1.0):
            return image
        factor = rng.uniform(*self.contrast)
        image = image * np.float32(factor) + np.float32((1 - factor) * image.mean())
        return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)

    def _add_piece(self, rng: Generator, image: RGBImage) -> None:
        """Paint a plain, printed or background piece onto ``image``, clipped at its border."""
        rows, columns = image.shape[:2]
        size = columns * math.exp(rng.uniform(*np.log(_WIDTHS)))
        outline = _outline(rng) * size / 2
        # Draw only the part within the image.
        corner = np.floor(rng.uniform(0, 1, 2) * (columns, rows) - size / 2).astype(int)
        first, last = np.maximum(corner, 0), np.minimum(corner + math.ceil(size), (columns, rows))
        if (last - first < 2).any():
            return
        wide, high = (last - first).tolist()
        mask = np.zeros((high, wide), np.uint8)
        points = np.round((outline + corner + size / 2 - first) * 2**_FINE_BITS).astype(np.int32)
        cv2.fillPoly(mask, [*points], 255, cv2.LINE_AA, _FINE_BITS)
        kind = rng.random()
        others = _printed if kind < _PLAIN_SHARE + _PRINTED_SHARE else self.behind.draw
        draw = _plain if kind < _PLAIN_SHARE else others
        piece = draw(rng, wide, high).astype(np.float32)
        region = image[first[1] : last[1], first[0] : last[0]]
        opacity = np.repeat(mask[..., None], 3, axis=2).astype(np.float32) / 255
        region[:] = np.rint(region + opacity * (piece - region))


def _outline(rng: Generator) -> Float[np.ndarray, "loops points 2"]:
    """Return one closed polygon, or a ring of two nested polygons, within the unit circle."""
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


def _plain(rng: Generator, width: int, height: int) -> RGBImage:
    """Return an image of one colour with a brightness gradient."""
    colour = rng.uniform(0, 255, 3)
    grey = colour.mean()
    colour = grey + rng.uniform(0, 1) * (colour - grey)
    direction = rng.uniform(-0.5, 0.5, 2)
    x, y = np.linspace(-1, 1, width)[None, :, None], np.linspace(-1, 1, height)[:, None, None]
    light = 1 + direction[0] * x + direction[1] * y
    return np.asarray(np.clip(colour * light, 0, 255), np.uint8)


def _printed(rng: Generator, width: int, height: int) -> RGBImage:
    """Return a rotated pattern of dark and light cells."""
    columns, rows = rng.integers(1, 9, 2)
    dark, light = rng.uniform((0, 140), (90, 255))
    cells = np.where(rng.random((rows, columns, 1)) < 0.5, dark, light) * rng.uniform(0.8, 1.2, 3)
    codes = np.asarray(np.clip(cells, 0, 255), np.uint8)
    upright = cv2.resize(codes, (width, height), interpolation=cv2.INTER_NEAREST)
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), rng.uniform(0, 360), 1.0)
    image = cv2.warpAffine(upright, turn, (width, height), borderMode=cv2.BORDER_WRAP)
    return np.asarray(image, np.uint8)
