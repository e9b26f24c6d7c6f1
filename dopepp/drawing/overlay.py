"""Wireframes of cuboids, lines and text on an image, for the visual inspection of poses.

A cuboid's +z face has bright, thick edges and an arrow head that points to +y. Two orientations of
a cube therefore never look equal, unless that face is seen edge-on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import resize_points
from dopepp.geometry.cuboid import CENTROID, CORNER_SIGNS, EDGES

Colour = tuple[int, int, int]  # Red, green and blue, 0 to 255

YELLOW: Final[Colour] = (255, 221, 0)
"""Colour of predictions, or of DOPE++ in a comparison of two networks (paper Fig. 14)."""

GREEN: Final[Colour] = (40, 220, 60)  # Colour of the ground truth
BLUE: Final[Colour] = (70, 165, 255)  # Colour of the DOPE baseline (paper Fig. 14)
WHITE: Final[Colour] = (255, 255, 255)  # Colour of captions
WEIGHT: Final = 500  # of the font's strokes; 400 is regular, 700 is bold
MIN_WIDTH_PX: Final = 640  # narrower images are enlarged, for readable lines and legends

_FRACTION_BITS: Final = 4  # sub-pixel coordinates of cv2 are integers, here in 1/16 pixel

_FRONT: Final = frozenset(np.flatnonzero(CORNER_SIGNS[:, 2] > 0).tolist())
_FRONT_BOTTOM: Final = tuple(np.flatnonzero((CORNER_SIGNS[:, 1:] == [-1, 1]).all(axis=1)).tolist())
_FRONT_TOP: Final = tuple(np.flatnonzero((CORNER_SIGNS[:, 1:] == [1, 1]).all(axis=1)).tolist())


@dataclass(frozen=True)
class Wireframe:
    """A projected cuboid to draw."""

    # Eight corners in NDDS order and the centroid, pixels; NaN if missing.
    keypoints: Float[np.ndarray, "9 2"]
    colour: Colour = YELLOW
    label: str = ""


def overlay(
    image: RGBImage, wireframes: Sequence[Wireframe], min_width_px: int = MIN_WIDTH_PX
) -> UInt8[np.ndarray, "out_height out_width 3"]:
    """Draw wireframes and a legend of their labels on a copy of the image.

    The image is enlarged by an integer factor to at least ``min_width_px``. Later wireframes cover
    earlier wireframes, so the ground truth should come first.
    """
    factor = max(1, -(-min_width_px // image.shape[1]))
    canvas = enlarge(image, factor)
    # On a sheet with tiles of half this width, lines are still a pixel wide.
    thickness = max(1, canvas.shape[1] // 320)
    for wireframe in wireframes:
        points = resize_points(wireframe.keypoints, factor, factor)
        canvas = draw_wireframe(canvas, points, wireframe.colour, thickness)
    labels = {cuboid.label: cuboid.colour for cuboid in wireframes if cuboid.label}
    size = max(12, canvas.shape[0] // 22)
    for line, (label, colour) in enumerate(labels.items()):
        draw_text(canvas, label, (size // 2, size // 2 + line * int(1.4 * size)), size, colour)
    return canvas


def draw_wireframe(
    image: RGBImage,
    keypoints: Float[np.ndarray, "9 2"],
    colour: Colour = YELLOW,
    thickness: int = 1,
) -> RGBImage:
    """Draw the edges of a projected cuboid, anti-aliased, on a copy of the image.

    ``keypoints`` are eight corners in NDDS order and the centroid, pixels; edges with a keypoint
    that is not finite are left out. Edges of the +z face are a pixel wider than ``thickness`` and
    brighter than the others.
    """
    canvas = np.ascontiguousarray(image).copy()
    points = np.asarray(keypoints, np.float64)
    shade = tuple(round(0.8 * value) for value in colour)  # for edges outside the +z face
    front = [edge for edge in EDGES if _FRONT.issuperset(edge)]
    for a, b in EDGES:
        if (a, b) not in front:
            draw_line(canvas, points[a], points[b], shade, thickness)
    tip = points[list(_FRONT_TOP)].mean(axis=0)
    for a in _FRONT_BOTTOM:
        draw_line(canvas, points[a], tip, colour, thickness)
    for a, b in front:
        draw_line(canvas, points[a], points[b], colour, thickness + 1)
    draw_line(canvas, points[CENTROID], points[CENTROID], colour, thickness + 3)
    return canvas


def enlarge(image: RGBImage, factor: int) -> UInt8[np.ndarray, "out_height out_width 3"]:
    """Return a copy of the image that is ``factor`` times as wide and high (bicubic)."""
    if factor == 1:
        return np.ascontiguousarray(image).copy()
    resized = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    return np.asarray(resized, np.uint8)


def draw_line(
    canvas: RGBImage,
    start: Float[np.ndarray, "2"],
    end: Float[np.ndarray, "2"],
    colour: tuple[int, ...],
    thickness: int,
) -> None:
    """Draw an anti-aliased line between two pixel positions on the canvas, in place.

    Equal ends give a dot. A line with an end that is not finite is not drawn.
    """
    clipped = _clip(start, end, canvas.shape[1], canvas.shape[0], margin=2 * thickness)
    if clipped is None:
        return
    ends = np.rint(np.array(clipped) * (1 << _FRACTION_BITS)).astype(int)
    a, b = ends.tolist()
    cv2.line(canvas, tuple(a), tuple(b), colour, thickness, cv2.LINE_AA, _FRACTION_BITS)


def _clip(
    start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"], width: int, height: int, margin: int
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]] | None:
    """Clip a segment to the image plus ``margin`` px (Liang–Barsky), else cv2 may overflow."""
    if not (np.isfinite(start).all() and np.isfinite(end).all()):
        return None
    direction = end - start
    first, last = 0.0, 1.0
    for axis, size in enumerate((width, height)):
        for sign, bound in ((-1, margin), (1, size - 1 + margin)):
            # Inside is sign·(start + s·direction) <= bound.
            slope, room = sign * direction[axis], bound - sign * start[axis]
            if slope > 0:
                last = min(last, room / slope)
            elif slope < 0:
                first = max(first, room / slope)
            elif room < 0:
                return None
    if first > last:
        return None
    return start + first * direction, start + last * direction


def draw_text(
    image: RGBImage, text: str, position: tuple[int, int], size_px: int, colour: Colour
) -> None:
    """Draw a line of text in place on a darkened box, cut off at the image border.

    ``position`` is (column, row) of the text's top left corner, pixels, at least 0.
    """
    column, row = position
    box = image[row : row + size_px, column:]
    coverage = text_coverage(text, size_px)[: box.shape[0], : box.shape[1], None]
    box = box[:, : coverage.shape[1]]
    # Darkening keeps any colour readable on any image.
    box[:] = np.rint(0.5 * box * (1 - coverage) + np.array(colour) * coverage)


def draw_caption(image: RGBImage, text: str) -> None:
    """Draw a line of text in place in the bottom left corner; nothing for an empty text."""
    size = max(12, round(max(image.shape[:2]) / 50))
    if text:
        draw_text(image, text, (0, max(image.shape[0] - size, 0)), size, WHITE)


def draw_tags(image: RGBImage, tags: Sequence[tuple[str, tuple[float, float], Colour]]) -> None:
    """Draw a line of text in place above each of several points, without overlap.

    A tag is a text, a point (column, row) in pixels and a colour; texts of points outside the image
    are drawn at the border.
    """
    size = max(12, round(max(image.shape[:2]) / 50))
    taken: list[tuple[int, int, int]] = []
    for text, (column, row), colour in tags:
        width = text_coverage(text, size).shape[1]
        left = int(min(max(column, 0), max(image.shape[1] - width, 0)))
        top = int(min(max(row - 1.3 * size, 0), max(image.shape[0] - size, 0)))
        while any(
            left < right and start < left + width and abs(top - above) < size
            for start, right, above in taken
        ):
            top += size
        taken.append((left, left + width, top))
        draw_text(image, text, (left, top), size, colour)


@lru_cache(maxsize=256)
def text_coverage(text: str, size_px: int) -> Float[np.ndarray, "size_px width"]:
    """Return each pixel's coverage by a line of text, in [0, 1]; cached, so do not modify it."""
    # Two ems per glyph are wide enough for all scripts; the result is cut to the measured width.
    pixels = np.zeros((size_px, size_px * (2 * len(text) + 1)), np.uint8)
    # The em is 0.66 of the line, which leaves room for ascenders and descenders.
    margin, baseline, em = size_px // 4, round(0.74 * size_px), round(0.66 * size_px)
    font = cv2.FontFace("sans")  # a font that OpenCV contains
    (end, _), _ = cv2.putText(pixels, text, (margin, baseline), (255,), font, em, WEIGHT)
    return pixels[:, : end + margin] / 255.0
