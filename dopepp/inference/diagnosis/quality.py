"""How sharp and how well exposed a picture is, by the picture alone."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float32

from dopepp.drawing.pictures import Picture

NARROWEST: Final = 0.5
"""Pixels: narrower edges are not told apart."""

FEWEST: Final = 8
"""Edges without which a picture does not tell how sharp it is."""

STRONG: Final = 0.3
"""Share of the strongest gradient: weaker edges are shading, noise, and out of focus."""

WHITE: Final = 250
"""Grey level from which on a pixel is taken for clipped, if all its channels are."""


def edge_width(picture: Picture) -> float | None:
    """Return the blur's standard deviation at the strongest edges, pixels; None without edges.

    A step blurred by σ has a gradient proportional to 1/√(σ² + s²) once it is blurred by s as well,
    so the ratio for s and 2s tells σ (Zhuo and Sim 2011); s is a pixel. Where edges are close to
    each other or noise is strong, the width is too small by up to a third; motion along an edge
    does not show.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = _gradient(grey, 1.0), _gradient(grey, 2.0)
    least = max(STRONG * float(np.percentile(fine, 99.5)), 2 * _noise(grey), 1.0)
    edges = (fine >= cv2.dilate(fine, np.ones((3, 3)))) & (fine > least)
    if np.count_nonzero(edges) < FEWEST:
        return None
    # 1 for a blur without end, 4 for none.
    ratio = float(np.clip((fine[edges].sum() / coarse[edges].sum()) ** 2, 1.001, 4.0))
    return max(NARROWEST, math.sqrt((4 - ratio) / (ratio - 1)))


def highlights(picture: Picture) -> float:
    """Return the grey level, of 255, that one pixel of a hundred exceeds."""
    return float(np.percentile(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), 99))


def clipped(picture: Picture) -> float:
    """Return the share of pixels that are white without detail."""
    return float((picture.min(axis=2) >= WHITE).mean())


def _gradient(
    grey: Float32[np.ndarray, "height width"], sigma_px: float
) -> Float32[np.ndarray, "height width"]:
    """Return the gradient of a blurred picture, grey levels a pixel."""
    soft = cv2.GaussianBlur(grey, (0, 0), sigma_px)
    # Scharr's filter weighs 16 on each side, two pixels apart.
    x, y = (cv2.Scharr(soft, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1)))
    return np.asarray(np.hypot(x, y))


def _noise(grey: Float32[np.ndarray, "height width"]) -> float:
    """Return the noise's standard deviation, grey levels (Immerkær 1996, with the median)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return float(np.median(np.abs(cv2.filter2D(grey, -1, kernel)))) / 0.6745 / 6
