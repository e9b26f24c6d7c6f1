"""What lies behind the scene: photos of a folder, or procedural textures.

To add a kind, write a class with the ``draw`` method of :class:`Backgrounds`.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from dopepp.errors import UserError

Field = Float32[np.ndarray, "height width"]

PHOTO_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".bmp", ".webp")

_LONGEST_PHOTO_PX: Final = 1024
"""Photos are kept reduced to this side: a 640×480 crop of them is still sharp."""

_SHARP_WIDTH_PX: Final = 256
"""Procedural textures up to this width are drawn at full resolution."""

_KEPT_PHOTOS: Final = 64
"""Decoded photos a process keeps: at most 64 × 1024 × 1024 × 3 bytes = 200 MB."""


class Backgrounds(Protocol):
    """Draws background images."""

    def draw(
        self, rng: np.random.Generator, width: int, height: int
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Return an RGB image of the asked size, a pure function of the generator's state."""


class PhotoBackgrounds:
    """Random crops of a folder's photos, mirrored and dimmed at random.

    Args:
        folder: Searched recursively; the photos' order is that of their relative paths.

    Raises:
        UserError: The folder is missing or holds no photo.
    """

    def __init__(self, folder: Path) -> None:
        self.paths = sorted(
            path for path in Path(folder).rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES
        )
        if not self.paths:
            raise UserError(
                f"no photo in the background folder {folder}",
                f"a folder with {', '.join(PHOTO_SUFFIXES)} files",
                "correct the path, or leave it out to use procedural backgrounds",
            )
        self._photos: OrderedDict[Path, UInt8[np.ndarray, "_ _ 3"]] = OrderedDict()

    def draw(
        self, rng: np.random.Generator, width: int, height: int
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Return a crop of the image's aspect ratio that covers 40 % to 100 % of a photo's side."""
        photo = self._photo(self.paths[int(rng.integers(len(self.paths)))])
        rows, columns = photo.shape[:2]
        scale = min(columns / width, rows / height) * rng.uniform(0.4, 1.0)
        crop_width, crop_height = max(int(width * scale), 1), max(int(height * scale), 1)
        left = int(rng.integers(columns - crop_width + 1))
        top = int(rng.integers(rows - crop_height + 1))
        crop = photo[top : top + crop_height, left : left + crop_width]
        if rng.random() < 0.5:
            crop = crop[:, ::-1]
        smaller = crop_width > width
        interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        image = cv2.resize(np.ascontiguousarray(crop), (width, height), interpolation=interpolation)
        return np.asarray(cv2.convertScaleAbs(image, alpha=float(rng.uniform(0.5, 1.1))), np.uint8)

    def _photo(self, path: Path) -> UInt8[np.ndarray, "_ _ 3"]:
        """Read a photo, reduced, and keep the most recent ones."""
        if path in self._photos:
            self._photos.move_to_end(path)
            return self._photos[path]
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise UserError(
                f"{path}, which cannot be decoded", "intact photos", "remove it from the folder"
            )
        scale = _LONGEST_PHOTO_PX / max(image.shape[:2])
        if scale < 1:
            image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        photo = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
        self._photos[path] = photo
        if len(self._photos) > _KEPT_PHOTOS:
            self._photos.popitem(last=False)
        return photo


class ProceduralBackgrounds:
    """Textures made from noise, gradients, tiles, bricks, wood and scattered shapes."""

    def draw(
        self, rng: np.random.Generator, width: int, height: int
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Return one texture, or two blended by a third, with 0 to 12 shapes scattered over it."""
        image = _texture(rng, width, height)
        if rng.random() < 0.4:
            weight = np.clip(_noise(rng, width, height, 2) * np.float32(3) - 1, 0, 1)
            other = _texture(rng, width, height)
            image = cv2.blendLinear(image, other, weight, 1 - weight)
        _scatter(rng, image, int(rng.integers(0, 13)))
        return np.asarray(image, np.uint8)


def _texture(
    rng: np.random.Generator, width: int, height: int
) -> UInt8[np.ndarray, "height width 3"]:
    """Return a random pattern in a random palette of two to five colours."""
    pattern = _PATTERNS[int(rng.integers(len(_PATTERNS)))]
    # A background is out of focus, more or less: large ones are drawn coarser and enlarged.
    scale = 1.0 if width <= _SHARP_WIDTH_PX else max(rng.uniform(0.4, 0.8), _SHARP_WIDTH_PX / width)
    columns, rows = round(width * scale), max(round(height * scale), 1)
    field = pattern(rng, columns, rows)
    grain = np.float32(rng.uniform(0.0, 0.25))
    field = (1 - grain) * field + grain * _noise(rng, columns, rows, int(rng.integers(16, 64)))
    codes = np.clip(field * 255, 0, 255).astype(np.uint8)
    if scale < 1.0:
        codes = np.asarray(cv2.resize(codes, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.asarray(cv2.applyColorMap(codes, _palette(rng)), np.uint8)


def _palette(rng: np.random.Generator) -> UInt8[np.ndarray, "256 1 3"]:
    """Return a colour map through random colours; most are muted or close to one colour."""
    count = int(rng.integers(2, 6))
    colours = rng.uniform(0, 255, (count, 3))
    if rng.random() < 0.5:
        colours = rng.uniform(20, 235, 3) + (colours - 127) * rng.uniform(0.1, 0.5)
    # Rooms and workshops are greyer than random colours: pull most palettes towards grey.
    grey = colours.mean(axis=1, keepdims=True)
    colours = grey + (colours - grey) * rng.uniform(0.0, 1.0)
    stops = np.linspace(0, 255, count)
    codes = np.arange(256)
    channels = [np.interp(codes, stops, colours[:, c]) for c in range(3)]
    return np.asarray(np.clip(np.stack(channels, axis=1), 0, 255), np.uint8)[:, None]


def _noise(rng: np.random.Generator, width: int, height: int, cells: int) -> Field:
    """Return smooth noise in [0, 1] with about ``cells`` cells along the image's width."""
    rows = max(round(cells * height / width), 1)
    grid = rng.random((rows + 1, cells + 1), np.float32)
    # Large cells show the creases of linear interpolation; small ones do not.
    smooth = cv2.INTER_CUBIC if cells * 8 <= width else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(grid, (width, height), interpolation=smooth))


def _clouds(rng: np.random.Generator, width: int, height: int) -> Field:
    """Return noise summed over several scales, each with a random share."""
    field = np.zeros((height, width), np.float32)
    total, cells, gain = 0.0, int(rng.integers(2, 8)), rng.uniform(0.4, 0.9)
    for octave in range(5):
        if cells * 2**octave > width:
            break
        cv2.scaleAdd(_noise(rng, width, height, cells * 2**octave), gain**octave, field, field)
        total += gain**octave
    # A sum of noises bunches around its middle: spread it over the palette.
    return np.asarray((field / total - 0.5) * 1.8 + 0.5)


def _coordinates(rng: np.random.Generator, width: int, height: int) -> tuple[Field, Field]:
    """Return image coordinates, turned, in perspective and bent; the width is about 1."""
    angle, bend = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.08)
    x = np.linspace(-0.5, 0.5, width, dtype=np.float32)[None]
    y = (np.linspace(-0.5, 0.5, height, dtype=np.float32) * (height / width))[:, None]
    depth = 1 + np.float32(rng.uniform(-0.8, 0.8)) * x + np.float32(rng.uniform(-0.8, 0.8)) * y
    cosine, sine = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    along, across = (cosine * x - sine * y) / depth, (sine * x + cosine * y) / depth
    if rng.random() < 0.5:
        along = along + np.float32(bend) * _noise(rng, width, height, 4)
    return along, across


def _gradient(rng: np.random.Generator, width: int, height: int) -> Field:
    along, across = _coordinates(rng, width, height)
    return np.asarray(along * np.float32(rng.uniform(0.5, 1.5)) + across * across + 0.5)


def _checker(rng: np.random.Generator, width: int, height: int) -> Field:
    along, across = _coordinates(rng, width, height)
    tiles = np.float32(rng.uniform(2, 16))
    odd = (np.floor(along * tiles) + np.floor(across * tiles)) % 2
    return odd * np.float32(0.6) + np.float32(0.2)


def _bricks(rng: np.random.Generator, width: int, height: int) -> Field:
    """Return a running bond with mortar joints and a shade of its own for every brick."""
    along, across = _coordinates(rng, width, height)
    across = across * np.float32(rng.uniform(4, 14))
    row = np.floor(across)
    along = along * np.float32(rng.uniform(2, 6)) + (row % 2) * np.float32(0.5)
    column = np.floor(along)
    joint = np.float32(rng.uniform(0.03, 0.15))
    mortar = (along - column < joint) | (across - row < 2 * joint)
    shades = rng.random(251, np.float32)
    shade = shades[(row * 17 + column * 31).astype(np.int32) % 251]
    return np.where(mortar, np.float32(rng.random()), 0.3 + 0.5 * shade)


def _wood(rng: np.random.Generator, width: int, height: int) -> Field:
    """Return year rings of a trunk cut lengthwise: bent stripes with fibres."""
    along, across = _coordinates(rng, width, height)
    rings = across * np.float32(rng.uniform(6, 30)) + 2 * _noise(rng, width, height, 3)
    rings += np.float32(rng.uniform(0, 4)) * along * along
    fibres = rng.random((max(height // 2, 1), max(width // 32, 1)), np.float32)
    fibre = cv2.resize(fibres, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(0.7 * (rings - np.floor(rings)) + 0.3 * fibre)


def _speckle(rng: np.random.Generator, width: int, height: int) -> Field:
    """Return fine noise over coarse noise: concrete, carpet, terrazzo."""
    cells = int(rng.integers(width // 4, width // 2 + 1))
    share = np.float32(rng.uniform(0.2, 0.7))
    return share * _noise(rng, width, height, cells) + (1 - share) * _clouds(rng, width, height)


_PATTERNS: Final[tuple[Callable[[np.random.Generator, int, int], Field], ...]] = (
    _clouds, _gradient, _checker, _bricks, _wood, _speckle,
)  # fmt: skip


def _scatter(
    rng: np.random.Generator, image: UInt8[np.ndarray, "height width 3"], count: int
) -> None:
    """Draw random ellipses, polygons, lines and circles over an image in place."""
    height, width = image.shape[:2]
    for _ in range(count):
        colour = tuple(float(value) for value in rng.integers(0, 256, 3))
        centre = rng.uniform(0, 1, 2) * (width, height)
        radius = width * rng.uniform(0.02, 0.2)
        kind = int(rng.integers(4))
        x, y = int(centre[0]), int(centre[1])
        if kind == 0:
            axes = (int(radius) + 1, int(radius * rng.uniform(0.3, 1)) + 1)
            turn = float(rng.uniform(0, 180))
            cv2.ellipse(image, (x, y), axes, turn, 0, 360, colour, -1, cv2.LINE_AA)
        elif kind == 1:
            corners = int(rng.integers(3, 7))
            angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
            outline = centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
            cv2.fillPoly(image, [outline.astype(np.int32)], colour, cv2.LINE_AA)
        elif kind == 2:
            end = rng.uniform(0, 1, 2) * (width, height)
            thickness = int(rng.integers(1, max(width // 40, 2)))
            cv2.line(image, (x, y), (int(end[0]), int(end[1])), colour, thickness, cv2.LINE_AA)
        else:
            thickness = int(rng.integers(1, max(width // 40, 2)))
            cv2.circle(image, (x, y), int(radius) + 1, colour, thickness, cv2.LINE_AA)
