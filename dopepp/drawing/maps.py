"""Belief maps laid over the image they were computed from."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.geometry.cuboid import CENTROID, NUM_KEYPOINTS


def map_panel(
    image: UInt8[np.ndarray, "height width 3"],
    belief: Float[np.ndarray, "9 map_height map_width"],
    stride: int = 8,
    tile_width: int = 240,
) -> UInt8[np.ndarray, "panel_height panel_width 3"]:
    """Draw an object's nine belief maps over the network's input image, with their maxima.

    Args:
        image: RGB, at the network's input scale; it may lack the padding on the right and below.
        belief: Maps whose peaks are 1; what is not finite or outside [0, 1] is clipped.
        stride: Pixels of the image per cell.
        tile_width: Width of one picture, pixels.

    Raises:
        ValueError: There are not nine maps, or they do not cover the image.
    """
    height, width = image.shape[:2]
    covers = stride * belief.shape[-2] >= height and stride * belief.shape[-1] >= width
    if belief.ndim != 3 or len(belief) != NUM_KEYPOINTS or not covers:
        raise ValueError(
            f"maps {belief.shape} with stride {stride} do not cover a {height}×{width} image"
        )
    tiles = []
    for k, channel in enumerate(np.nan_to_num(np.asarray(belief, np.float32))):
        name = "centroid" if k == CENTROID else f"corner {k}"
        caption = f"{name}, max {channel.max():.2f}"
        tiles.append(Tile(heat_picture(image, channel, stride), caption))
    return contact_sheet(tiles, columns=3, tile_width=tile_width)


def heat_picture(
    image: UInt8[np.ndarray, "height width 3"],
    channel: Float[np.ndarray, "map_height map_width"],
    stride: int = 8,
) -> UInt8[np.ndarray, "height width 3"]:
    """Blend one map into the dimmed image, the more opaque the stronger the belief.

    Args:
        image: RGB, at the network's input scale.
        channel: A map that covers it; values are clipped to [0, 1].
        stride: Pixels of the image per cell.
    """
    # cv2's resize keeps pixel centres: cell i lands on pixel stride·i + (stride − 1)/2.
    large = cv2.resize(channel, None, fx=stride, fy=stride, interpolation=cv2.INTER_LINEAR)
    share = np.clip(large[: image.shape[0], : image.shape[1]], 0.0, 1.0)
    heat = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_JET)
    weight = (0.8 * share)[..., None]
    # The picture is dimmed, so that a faint belief is not lost in a bright background.
    blended = (1 - weight) * 0.6 * image + weight * heat[..., ::-1]
    return np.asarray(np.rint(blended), np.uint8)
