"""BOP's images as bytes, in a file or in a tar member: read whole or refused, and written.

Masks in BOP-WebDataset are run lengths down the columns, as COCO's uncompressed RLE:
``{"size": [height, width], "counts": [zeros, ones, zeros, …]}``.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from dopepp.data.formats.problems import (
    COLOUR_MODES,
    STRICT,
    Place,
    mapping,
    one_channel,
    picture,
)
from dopepp.drawing.pictures import DepthMap, Mask, Picture, Shape

DEPTH_SCALES_MM: Final = (0.1, 1.0)
"""Millimetres a unit of the depth images that are written: up to 6.5 m, and up to 65 m."""

DEPTH_MODES: Final = ("I;16", "I;16B", "I", "L")
"""Pillow's names of the whole numbers that a depth image may hold."""

_MAX_UNITS: Final = 65_535


def decode_rgb(content: bytes, where: str) -> Picture:
    """Read a colour or grey image as RGB; an alpha channel is dropped.

    A UserError: it is no PNG, JPEG or TIFF, damaged, too large, or not of 8 bits.
    """
    image = picture(Place(STRICT, where), content, COLOUR_MODES)
    assert image is not None
    return np.array(image.convert("RGB"))


def decode_depth(content: bytes, where: str, depth_scale: float, shape: Shape) -> DepthMap:
    """Read a depth image as metres, float32, 0 where unknown.

    ``depth_scale`` is millimetres a unit, NaN where it is not stated; ``shape`` the colour image's.
    A UserError: as :func:`decode_rgb`, or another size, no whole numbers, or no scale.
    """
    place = Place(STRICT, where)
    units = one_channel_of(place, shape, content, DEPTH_MODES)
    assert units is not None
    if np.isnan(depth_scale):
        allowed = "depth_scale (mm a unit) beside the image's cam_K"
        place["image"].report("no depth_scale", allowed)
    return (units.astype(np.float64) * (depth_scale / 1000)).astype(np.float32)


def decode_mask(content: bytes, where: str, shape: Shape) -> Mask:
    """Read a mask of an image of ``shape`` (height, width); every pixel but 0 is the object's.

    A UserError: as :func:`decode_rgb`, or it is of another size or has several channels.
    """
    mask = one_channel_of(Place(STRICT, where), shape, content)
    assert mask is not None
    return np.asarray(mask != 0)


def one_channel_of(
    place: Place, shape: Shape | None, content: bytes | None = None, modes: tuple[str, ...] = ()
) -> NDArray[Any] | None:
    """Read a depth image or a mask as it is, None where that is impossible.

    ``content`` are its bytes, where they do not lie on the disk by themselves; ``modes`` Pillow's
    names of the pixels it may have, none for any with one channel.
    """
    image = picture(place, content)
    if image is None:
        return None
    if len(image.getbands()) > 1 or (modes and image.mode not in modes):
        allowed = "one channel of 16-bit whole numbers" if modes else "one channel"
        place["channels"].report(f"pixels of type {image.mode}", allowed)
        return None
    return one_channel(place, np.asarray(image), shape)


def encode_png(pixels: NDArray[Any]) -> bytes:
    """Return an RGB (uint8) or one-channel (uint8, uint16) image as PNG."""
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".png", pixels)[1])


def depth_units(depth: DepthMap, covered: Mask) -> tuple[NDArray[np.uint16], float]:
    """Turn metres into units of a 16-bit image and return them with BOP's ``depth_scale``.

    The finest scale that reaches to the farthest object is taken, which is 0.1 mm within 6.5 m.
    What lies beyond the scale's range (a background) becomes 0, unknown.

    ``depth`` is in metres, 0 where unknown; ``covered`` are the objects' pixels.
    """
    farthest = 1000 * float(depth[covered].max(initial=0.0))
    fine, coarse = DEPTH_SCALES_MM
    scale = fine if farthest <= _MAX_UNITS * fine else coarse
    units = np.rint(np.asarray(depth, np.float64) * (1000 / scale))
    return np.where(units <= _MAX_UNITS, units, 0).astype(np.uint16), scale


def encode_runs(mask: Mask) -> dict[str, list[int]]:
    """Return a mask as run lengths, the first of which counts zeros."""
    pixels = mask.ravel(order="F")
    borders = np.flatnonzero(np.diff(pixels)) + 1
    runs = np.diff(np.concatenate([[0], borders, [pixels.size]])).tolist()
    return {"counts": [0, *runs] if pixels.size and pixels[0] else runs, "size": list(mask.shape)}


def decode_runs(record: object, shape: Shape, place: Place) -> Mask | None:
    """Read a mask of an image of ``shape`` (height, width), None where that is impossible.

    ``record`` is a JSON value that anybody may have written: it must have that size, so a file
    cannot ask for more memory, and its runs must fill it.
    """
    fields = mapping(record)
    counts, size = fields.get("counts"), fields.get("size")
    whole = isinstance(counts, list) and all(type(n) is int and n >= 0 for n in counts)
    if size != list(shape):
        got = "missing" if record is None else f"size {size!r:.40}"
        allowed = f"runs of size [{shape[0]}, {shape[1]}], the image's"
    elif not whole or counts is None or sum(counts) != shape[0] * shape[1]:
        got = f"counts {counts!r:.40}"
        allowed = f"a list of run lengths that add up to {shape[0] * shape[1]} pixels"
    else:
        pixels = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
        return np.asarray(pixels.reshape(shape, order="F"))
    place.report(got, allowed)
    return None
