"""Panels that show a labelled image: instance masks in colours, depth as colour, object axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from dopepp.drawing.overlay import Colour

COLOURS: Final[tuple[Colour, ...]] = (
    (230, 25, 75), (60, 180, 75), (255, 225, 25), (0, 130, 200), (245, 130, 48),
    (145, 30, 180), (70, 240, 240), (240, 50, 230), (210, 245, 60), (250, 190, 212),
)  # fmt: skip
"""Of the first, second, … instance; easy to tell apart, also with most colour blindness."""

AXIS_COLOURS: Final[tuple[Colour, ...]] = ((255, 60, 60), (60, 255, 60), (90, 140, 255))
"""x red, y green, z blue, as everywhere."""

_GROUND: Final = 0.35
"""Brightness of the image below the masks."""

_COVER: Final = 0.65
"""Opacity of a mask."""

_MARGIN: Final = 0.1
"""The colour scale is wider than the objects' depths by this share of their range at both ends."""

_FRACTION_BITS: Final = 4
"""cv2 takes sub-pixel coordinates as integers, here in 1/16 pixel."""


def mask_panel(
    image: UInt8[np.ndarray, "height width 3"],
    masks: Sequence[Bool[np.ndarray, "height width"] | None],
) -> UInt8[np.ndarray, "height width 3"]:
    """Paint each instance's visible pixels in its colour on the darkened, grey image."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None].repeat(3, axis=2)
    panel = _GROUND * grey.astype(np.float64)
    for number, mask in enumerate(masks):
        if mask is not None:
            colour = np.array(COLOURS[number % len(COLOURS)])
            panel[mask] = (1 - _COVER) * grey[mask] + _COVER * colour
    return np.asarray(np.rint(panel), np.uint8)


def depth_panel(
    depth: Float[np.ndarray, "height width"], shown: Bool[np.ndarray, "height width"]
) -> tuple[UInt8[np.ndarray, "height width 3"], str]:
    """Colour depth from near (red) to far (blue); unknown depth is black.

    Args:
        depth: Metres, 0 where unknown.
        shown: Pixels that the scale is for: those of the objects. A plane that reaches far behind
            them would leave them one colour.

    Returns:
        The panel, and the scale's ends in words.
    """
    known = depth > 0
    scale = depth[known & shown] if (known & shown).any() else depth[known]
    if not scale.size:
        return np.zeros((*depth.shape, 3), np.uint8), "no depth"
    near, far = float(scale.min()), float(scale.max())
    margin = max(_MARGIN * (far - near), 1e-3)  # at least a millimetre, also of a flat depth
    near, far = max(near - margin, 0.0), far + margin
    share = np.clip((far - depth) / (far - near), 0, 1)
    coloured = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)
    panel = cv2.cvtColor(coloured, cv2.COLOR_BGR2RGB)
    panel[~known] = 0
    return np.asarray(panel, np.uint8), f"depth: red {near:.3f} m to blue {far:.3f} m"


def draw_axes(
    image: UInt8[np.ndarray, "height width 3"], ends: Float[np.ndarray, "4 2"], thickness: int = 2
) -> None:
    """Draw the object frame's axes IN PLACE.

    Args:
        image: RGB.
        ends: Where the origin and the tips of x, y and z are seen, pixels; a line whose end is not
            finite or far outside is left out.
        thickness: Pixels.
    """
    # cv2 overflows far outside of the image.
    bound = 10 * max(image.shape)
    visible = np.isfinite(ends).all(axis=1) & (np.abs(np.nan_to_num(ends)) < bound).all(axis=1)
    points = np.rint(np.where(visible[:, None], ends, 0) * (1 << _FRACTION_BITS)).astype(int)
    for tip, colour in zip((1, 2, 3), AXIS_COLOURS, strict=True):
        if visible[0] and visible[tip]:
            start, end = points[0].tolist(), points[tip].tolist()
            cv2.line(image, start, end, colour, thickness, cv2.LINE_AA, _FRACTION_BITS)
