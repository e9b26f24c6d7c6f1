"""Contact sheets of captioned images, and their panels: masks, depth, axes and messages."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float

from dopepp.drawing.overlay import WHITE, Colour, draw_line, draw_text, text_coverage
from dopepp.drawing.pictures import DepthMap, Mask, RGBImage
from dopepp.geometry.cuboid import CENTROID

_CAPTION_PX: Final = 18
_MIN_CAPTION_PX: Final = 9  # smallest readable text height; text that is still too long is cut

COLOURS: Final[tuple[Colour, ...]] = (
    (230, 25, 75), (60, 180, 75), (255, 225, 25), (0, 130, 200), (245, 130, 48),
    (145, 30, 180), (70, 240, 240), (240, 50, 230), (210, 245, 60), (250, 190, 212),
)  # fmt: skip
"""Colours of object instances, distinguishable with most kinds of colour blindness."""

AXIS_COLOURS: Final[tuple[Colour, ...]] = ((255, 60, 60), (60, 255, 60), (90, 140, 255))
"""Colours of the axes x (red), y (green) and z (blue)."""

_MASK_OPACITY: Final = 0.65


@dataclass(frozen=True)
class Tile:
    """An image of a contact sheet, with an optional line of text below."""

    image: RGBImage
    caption: str = ""


def contact_sheet(tiles: Sequence[Tile], columns: int = 4, tile_width: int = 320) -> RGBImage:
    """Arrange tiles row by row on white, each scaled to a width of ``tile_width`` pixels.

    Raises:
        ValueError: There are no tiles.
    """
    gap = 6
    drawn = [
        np.pad(_draw_tile(tile, tile_width), ((gap, 0), (gap, 0), (0, 0)), constant_values=255)
        for tile in tiles
    ]
    return np.pad(grid(drawn, columns), ((0, gap), (0, gap), (0, 0)), constant_values=255)


def _draw_tile(tile: Tile, width: int) -> RGBImage:
    """Scale a tile's image to a width (pixels) and add its caption below."""
    scale = width / tile.image.shape[1]
    height = max(1, round(tile.image.shape[0] * scale))
    # Area averaging suits shrinking; cubic interpolation suits enlarging.
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    image = np.asarray(cv2.resize(tile.image, (width, height), interpolation=method), np.uint8)
    return np.concatenate([image, text_line(tile.caption, width)]) if tile.caption else image


def text_line(text: str, width: int) -> RGBImage:
    """Return black text on a white strip of ``width`` pixels, as small as needed to fit."""
    # Hinted glyphs do not scale exactly with the size, so sizes are tried in descending order.
    lines = (text_coverage(text, px) for px in range(_CAPTION_PX, _MIN_CAPTION_PX, -1))
    smallest = text_coverage(text, _MIN_CAPTION_PX)
    coverage = next((line for line in lines if line.shape[1] <= width), smallest)[:, :width, None]
    strip = np.full((_CAPTION_PX, width, 3), 255, np.uint8)
    strip[: coverage.shape[0], : coverage.shape[1]] = np.rint(255 * (1 - coverage))
    return strip


def grid(images: Sequence[RGBImage], columns: int) -> RGBImage:
    """Arrange images row by row on white, without gaps; images of a row are aligned at the top.

    Raises:
        ValueError: There are no images or no columns.
    """
    if not images or columns < 1:
        raise ValueError(f"a grid needs images and columns, got {len(images)} and {columns}")
    rows = [images[i : i + columns] for i in range(0, len(images), columns)]
    width = max(sum(image.shape[1] for image in row) for row in rows)
    bands = []
    for row in rows:
        band = np.full((max(image.shape[0] for image in row), width, 3), 255, np.uint8)
        left = 0
        for image in row:
            band[: image.shape[0], left : left + image.shape[1]] = image
            left += image.shape[1]
        bands.append(band)
    return np.concatenate(bands)


def message_image(width: int, height: int, text: str) -> RGBImage:
    """Return a grey image (size in pixels) with wrapped text; lines that do not fit are cut."""
    image = np.full((height, width, 3), 225, np.uint8)
    size = max(10, int(0.05 * width))
    # On average, a character is half as wide as the line is high.
    per_line = max(10, int((width - 2 * size) / (0.52 * size)))
    for number, line in enumerate(textwrap.wrap(text, per_line)):
        top = size + number * (size + size // 4)
        if top + size > height:
            break
        draw_text(image, line, (size, top), size, WHITE)
    return image


def belief_tiles(
    image: RGBImage, beliefs: Float[np.ndarray, "9 map_height map_width"], stride: int, name: str
) -> list[Tile]:
    """Return two tiles of belief maps over an image: the corners' maximum, and the centroid's.

    Captions begin with ``name`` and end with the largest belief. ``stride`` is in pixels per cell.
    """
    maps = {"corners": beliefs[:CENTROID].max(axis=0), "centroid": beliefs[CENTROID]}
    return [
        Tile(heat_image(image, belief, stride), f"{name} {title}, max {belief.max():.2f}")
        for title, belief in maps.items()
    ]


def heat_image(
    image: RGBImage, channel: Float[np.ndarray, "map_height map_width"], stride: int = 8
) -> RGBImage:
    """Blend the belief map ``channel`` (0 to 1) into the dimmed image, with opacity 0.8 × belief.

    The image has the scale of the network's input, ``stride`` pixels per cell of the map.
    """
    # cv2's resize keeps pixel centres: cell i lands on pixel stride·i + (stride − 1)/2.
    large = cv2.resize(channel, None, fx=stride, fy=stride, interpolation=cv2.INTER_LINEAR)
    share = np.clip(large[: image.shape[0], : image.shape[1]], 0.0, 1.0)
    heat = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_JET)
    weight = (0.8 * share)[..., None]
    # Dim the image, so that a faint belief is visible on a bright background.
    blended = (1 - weight) * 0.6 * image + weight * heat[..., ::-1]
    return np.asarray(np.rint(blended), np.uint8)


def mask_panel(image: RGBImage, masks: Sequence[Mask | None]) -> RGBImage:
    """Paint each instance's mask in the instance's colour on the darkened grey image."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None].repeat(3, axis=2)
    panel = 0.35 * grey.astype(np.float64)
    for number, mask in enumerate(masks):
        if mask is not None:
            colour = np.array(COLOURS[number % len(COLOURS)])
            panel[mask] = (1 - _MASK_OPACITY) * grey[mask] + _MASK_OPACITY * colour
    return np.asarray(np.rint(panel), np.uint8)


def depth_panel(depth: DepthMap, shown: Mask) -> tuple[RGBImage, str]:
    """Colour depth from near (red) to far (blue), unknown depth black; return image and legend.

    The colours span the depths of the ``shown`` pixels (the objects), because a plane may extend
    far behind the objects.
    """
    measured = depth > 0
    scale = depth[measured & shown] if (measured & shown).any() else depth[measured]
    if not scale.size:
        return np.zeros((*depth.shape, 3), np.uint8), "no depth"
    near, far = float(scale.min()), float(scale.max())
    # Extend both ends by a tenth of the range, at least a millimetre for a flat depth.
    margin = max(0.1 * (far - near), 1e-3)
    near, far = max(near - margin, 0.0), far + margin
    share = np.clip((far - depth) / (far - near), 0, 1)
    coloured = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)
    panel = cv2.cvtColor(coloured, cv2.COLOR_BGR2RGB)
    panel[~measured] = 0
    return np.asarray(panel, np.uint8), f"depth: red {near:.3f} m to blue {far:.3f} m"


def draw_axes(image: RGBImage, ends: Float[np.ndarray, "4 2"]) -> None:
    """Draw an object frame's axes on the image, in place.

    ``ends`` are the projections of the origin and of the tips of x, y and z, pixels. An axis with
    an end that is not finite or is beyond 10 times the image's longer side is not drawn.
    """
    bound = 10 * max(image.shape)
    for tip, colour in zip(ends[1:], AXIS_COLOURS, strict=True):
        if (np.abs([ends[0], tip]) < bound).all():
            draw_line(image, ends[0], tip, colour, 2)
