"""Contact sheets: many captioned pictures as one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from dopepp.drawing.overlay import text_coverage
from dopepp.drawing.panels import grid
from dopepp.drawing.pictures import Picture

_GAP_PX: Final = 6
_CAPTION_PX: Final = 18
_MIN_CAPTION_PX: Final = 9
"""Smallest readable line; what is still too long at this size is cut."""


@dataclass(frozen=True)
class Tile:
    """One picture of a contact sheet.

    ``caption`` is one line below it; empty for none.
    """

    image: Picture
    caption: str = ""


def contact_sheet(tiles: Sequence[Tile], columns: int = 4, tile_width: int = 320) -> Picture:
    """Lay tiles out row by row on white, each scaled to one width with its shape kept.

    A row has ``columns`` tiles at most; ``tile_width`` is in pixels.

    Raises:
        ValueError: There are no tiles, or a size is below 1.
    """
    if not tiles or columns < 1 or tile_width < 1:
        raise ValueError(
            f"a sheet needs tiles, columns and a width, got {len(tiles)}, {columns}, {tile_width}"
        )
    gap = _GAP_PX
    drawn = [
        np.pad(_draw_tile(tile, tile_width), ((gap, 0), (gap, 0), (0, 0)), constant_values=255)
        for tile in tiles
    ]
    return np.pad(grid(drawn, columns), ((0, gap), (0, gap), (0, 0)), constant_values=255)


def _draw_tile(tile: Tile, width: int) -> Picture:
    """Scale the picture and put its caption, shrunk to fit, below it."""
    scale = width / tile.image.shape[1]
    height = max(1, round(tile.image.shape[0] * scale))
    # Averaging is right for shrinking, cubic for enlarging.
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    picture = cv2.resize(tile.image, (width, height), interpolation=method)
    if not tile.caption:
        return np.asarray(picture, np.uint8)
    # Glyphs are hinted, so their width does not follow the size exactly: try, largest first.
    lines = (text_coverage(tile.caption, px) for px in range(_CAPTION_PX, _MIN_CAPTION_PX, -1))
    smallest = text_coverage(tile.caption, _MIN_CAPTION_PX)
    coverage = next((line for line in lines if line.shape[1] <= width), smallest)[:, :width, None]
    strip = np.full((_CAPTION_PX, width, 3), 255, np.uint8)
    strip[: coverage.shape[0], : coverage.shape[1]] = np.rint(255 * (1 - coverage))
    return np.concatenate([picture, strip])
