"""Text on images, in any script matplotlib's own font has (cv2's fonts know ASCII only)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_POINTS_PER_PX = 72 / 100
"""At 100 dots per inch a pixel is 0.72 typographic points."""


def draw_text(
    image: UInt8[np.ndarray, "height width 3"],
    text: str,
    position: tuple[int, int],
    size_px: int,
    colour: tuple[int, int, int],
) -> None:
    """Write one line IN PLACE on a darkened box; what leaves the image is cut off.

    Args:
        image: RGB.
        text: The line.
        position: Column and row of its top left corner, pixels, not negative.
        size_px: Height of the line, pixels.
        colour: RGB.
    """
    column, row = position
    place = image[row : row + size_px, column:]
    coverage = text_coverage(text, size_px)[: place.shape[0], : place.shape[1], None]
    place = place[:, : coverage.shape[1]]
    # Half-dark ground keeps any colour readable on any picture.
    place[:] = np.rint(0.5 * place * (1 - coverage) + np.array(colour) * coverage)


@lru_cache(maxsize=256)
def text_coverage(text: str, size_px: int) -> Float[np.ndarray, "size_px width"]:
    """Rasterise one line: how much of each pixel the glyphs cover, in [0, 1]; do not change it."""
    # Wide enough for any glyph (an em each), cut to the measured width afterwards.
    width = size_px * (len(text) + 1)
    figure = Figure(figsize=(width / 100, size_px / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    # 0.72 of the line is the em, so that ascenders and descenders stay inside.
    label = figure.text(
        size_px / 4 / width,
        0.28,
        text,
        fontsize=0.72 * size_px * _POINTS_PER_PX,
        va="baseline",
        parse_math=False,
    )
    canvas.draw()  # type: ignore[no-untyped-call]
    used = int(np.ceil(label.get_window_extent().x1 + size_px / 4))
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return 1.0 - pixels[:, :used, 0] / 255.0
