"""The part of a picture that a posed part can have to do with, smaller where that is enough."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from dopepp.geometry.camera import CameraMatrix, crop_camera, resize_camera
from dopepp.inference.refinement.colour import colour_bins

SMALLEST_PX: Final = 12
"""A part that is shorter on the picture shows no outline."""

MARGIN: Final = 0.35
"""Of the part's extent, looked at around it."""

EDGE_PX: Final = 6.0
"""Looked at around it besides: an outline is looked for no nearer."""


@dataclass(frozen=True, eq=False)
class Crop:
    """A piece of a picture.

    Attributes:
        colours: RGB.
        K: Its camera matrix, pixels.
        extent: Longer side of the part on it, pixels.
        scale: Its pixels per pixel of the picture: 1 over a whole number.
    """

    colours: UInt8[np.ndarray, "height width 3"]
    K: CameraMatrix
    extent: float
    scale: float

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.colours.shape[1], self.colours.shape[0]

    @cached_property
    def bins(self) -> Int[np.ndarray, "height width"]:
        """The colours as one number a pixel; of rounds that are left out, nobody asks for it."""
        return colour_bins(self.colours)


def crop_around(
    image: UInt8[np.ndarray, "height width 3"],
    K: CameraMatrix,
    corners: Float[np.ndarray, "2 2"],
    longest_px: int,
) -> Crop | str:
    """Cut out a posed part and what is around it; where there is too little, say so.

    Args:
        image: RGB.
        K: Its camera matrix, pixels.
        corners: The upper left and the lower right one of the part's box on it.
        longest_px: About so long is the part on the crop at most.
    """
    lower, upper = corners
    extent = float((upper - lower).max())
    if extent < SMALLEST_PX:
        return f"the part is only {extent:.0f} pixels long"
    edge = MARGIN * extent + EDGE_PX
    limit = np.array(image.shape[1::-1])
    left, top = np.clip(np.floor(lower - edge), 0, limit).astype(int)
    right, bottom = np.clip(np.ceil(upper + edge) + 1, 0, limit).astype(int)
    if min(right - left, bottom - top) < SMALLEST_PX:
        return "the part lies outside the picture"
    # Whole numbers of pixels become one: that is exact, and many times faster than any other share.
    most = min(right - left, bottom - top) // SMALLEST_PX
    few = min(max(1, round(extent / longest_px)), most)
    width, height = (right - left) // few, (bottom - top) // few
    colours = image[top : top + few * height, left : left + few * width]
    own = crop_camera(K, left, top)
    if few > 1:
        own = resize_camera(own, 1 / few, 1 / few)
        colours = cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA)
    colours = np.ascontiguousarray(colours)
    return Crop(colours, own, extent / few, 1 / few)
