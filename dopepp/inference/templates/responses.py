"""Responses of an image's edges, one map for each orientation.

A response is high near an edge of the map's orientation: orientations are spread to neighbouring
pixels as in LINE-2D (Hinterstoisser et al. 2012). The mean response of the surroundings is
subtracted, because in busy texture every pixel is near edges of all orientations.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from jaxtyping import Int8

from dopepp.core.compiled import Array, compiled
from dopepp.drawing.pictures import RGBImage

BINS: Final = 16  # orientations, modulo 180 degrees
NOISE: Final = 8.0  # gradient, grey levels per pixel, at which an edge has half its response
FULL: Final = 127.0  # response of a strong edge of the same orientation
FAINT: Final = 12.0  # response below which a pixel does not count as an edge

Responses = Int8[np.ndarray, "bins height width"]


def edge_responses(image: RGBImage, spread: int, surroundings: int) -> Responses:
    """Return the response of each pixel to edges of each orientation.

    Args:
        image: RGB.
        spread: Side of the square in which an edge counts as near, pixels, odd.
        surroundings: Side of the square whose mean response is subtracted, pixels.
    """
    soft = cv2.GaussianBlur(image, (3, 3), 0.8)
    gx = cv2.Scharr(soft, cv2.CV_32F, 1, 0, scale=1 / 32)
    gy = cv2.Scharr(soft, cv2.CV_32F, 0, 1, scale=1 / 32)
    maps = np.zeros((BINS, *image.shape[:2]), np.uint8)
    _orient(gx, gy, maps)
    kernel = np.ones((spread, spread), np.uint8)
    responses = np.stack([cv2.dilate(response, kernel) for response in maps]).astype(np.int8)
    mean = responses.mean(axis=0, dtype=np.float32)
    side = (surroundings, surroundings)
    responses -= np.rint(cv2.blur(mean, side, borderType=cv2.BORDER_REFLECT)).astype(np.int8)
    return responses


@compiled()
def _orient(gx: Array, gy: Array, maps: Array) -> None:
    """Write to ``maps`` each pixel's response to the strongest gradient of its channels."""
    bins, height, width = maps.shape
    cosines, sines = np.empty(bins), np.empty(bins)
    for b in range(bins):
        cosines[b], sines[b] = math.cos(b * math.pi / bins), math.sin(b * math.pi / bins)
    for v in range(height):
        for u in range(width):
            longest, x, y = 0.0, 0.0, 0.0
            for c in range(3):
                square = gx[v, u, c] * gx[v, u, c] + gy[v, u, c] * gy[v, u, c]
                if square > longest:
                    longest, x, y = square, gx[v, u, c], gy[v, u, c]
            length = math.sqrt(longest)
            strength = FULL * length / (length + NOISE)
            if strength < FAINT:
                continue
            for b in range(bins):
                cosine = (x * cosines[b] + y * sines[b]) / length
                maps[b, v, u] = int(strength * cosine * cosine * cosine * cosine)


@compiled(fastmath=True)
def orientation_bin(angle: float) -> int:
    """Return the map of the edges whose normals have a direction, radians, above −8π."""
    return int(angle * BINS / math.pi + 8 * BINS + 0.5) % BINS  # of a positive number
