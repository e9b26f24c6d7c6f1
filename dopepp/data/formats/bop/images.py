"""Masks in BOP-WebDataset: run lengths down the columns, as COCO's uncompressed RLE.

``{"size": [height, width], "counts": [zeros, ones, zeros, …]}``.

BOP's images as bytes, in a file or in a tar member, read whole or refused.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import MAX_PIXELS, whole_picture

FORMATS: Final = ("PNG", "JPEG", "TIFF")

DEPTH_SCALES_MM: Final = (0.1, 1.0)
"""Millimetres a unit of the depth images that are written: up to 6.5 m, and up to 65 m."""

_MAX_UNITS: Final = 65_535
_DEPTH_MODES: Final = ("I;16", "I;16B", "I", "L")


def encode_png(pixels: NDArray[Any]) -> bytes:
    """Return an RGB (uint8) or one-channel (uint8, uint16) image as PNG."""
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".png", pixels)[1])


def depth_units(
    depth: Float[np.ndarray, "height width"], covered: Bool[np.ndarray, "height width"]
) -> tuple[NDArray[np.uint16], float]:
    """Turn metres into units of a 16-bit image and return them with BOP's ``depth_scale``.

    The finest scale that reaches to the farthest object is taken, which is 0.1 mm within 6.5 m.
    What lies beyond the scale's range (a background) becomes 0, unknown.

    Args:
        depth: Metres, 0 where unknown.
        covered: The objects' pixels.
    """
    farthest = 1000 * float(depth[covered].max(initial=0.0))
    fine, coarse = DEPTH_SCALES_MM
    scale = fine if farthest <= _MAX_UNITS * fine else coarse
    units = np.rint(np.asarray(depth, np.float64) * (1000 / scale))
    return np.where(units <= _MAX_UNITS, units, 0).astype(np.uint16), scale


def decode_rgb(content: bytes, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """Read a colour or grey image as RGB; an alpha channel is dropped.

    Args:
        content: The file.
        where: Its name, for the error.

    Raises:
        UserError: It is none of :data:`FORMATS`, damaged, too large, or not of 8 bits.
    """
    image = _decode(content, where)
    if image.mode not in ("RGB", "RGBA", "L", "LA", "P", "CMYK", "YCbCr"):
        raise _bad(where, f"pixels of type {image.mode}", "colour or grey of 8 bits")
    return np.array(image.convert("RGB"))


def decode_depth(
    content: bytes, where: str, depth_scale: float, shape: tuple[int, int]
) -> Float[np.ndarray, "height width"]:
    """Read a depth image as metres, float32, 0 where unknown.

    Args:
        content: The file.
        where: Its name, for the error.
        depth_scale: Millimetres a unit; NaN where it is not stated.
        shape: (height, width) of the colour image.

    Raises:
        UserError: It is none of :data:`FORMATS`, damaged, of another size, has no whole numbers, or
            no scale.
    """
    image = _decode(content, where)
    if image.mode not in _DEPTH_MODES:
        raise _bad(where, f"pixels of type {image.mode}", "one channel of 16-bit whole numbers")
    if np.isnan(depth_scale):
        raise _bad(where, "no depth_scale", "depth_scale (mm a unit) beside the image's cam_K")
    _check_shape(image, where, shape)
    return (np.asarray(image, np.float64) * (depth_scale / 1000)).astype(np.float32)


def decode_mask(
    content: bytes, where: str, shape: tuple[int, int]
) -> Bool[np.ndarray, "height width"]:
    """Read a mask; every pixel but 0 belongs to the object.

    Args:
        content: The file.
        where: Its name, for the error.
        shape: (height, width) of the colour image.

    Raises:
        UserError: It is none of :data:`FORMATS`, damaged, of another size or has several channels.
    """
    image = _decode(content, where)
    if len(image.getbands()) != 1:
        raise _bad(where, f"pixels of type {image.mode}", "one channel")
    _check_shape(image, where, shape)
    return np.asarray(np.asarray(image) != 0)


def _check_shape(image: Image.Image, where: str, shape: tuple[int, int]) -> None:
    if (image.height, image.width) != shape:
        allowed = f"{shape[1]}×{shape[0]}, the colour image's size"
        raise _bad(where, f"{image.width}×{image.height} pixels", allowed)


def _decode(content: bytes, where: str) -> Image.Image:
    allowed = f"a whole {', '.join(FORMATS)} image of at most {MAX_PIXELS / 1e6:.0f} megapixels"
    try:
        return whole_picture(content, FORMATS)
    except ValueError as error:
        raise _bad(where, f"{len(content)} bytes: {error}", allowed) from error


def _bad(where: str, got: str, allowed: str) -> UserError:
    return UserError(f"image {where}: {got}", allowed, "copy or download the file again")


def encode_runs(mask: Bool[np.ndarray, "height width"]) -> dict[str, list[int]]:
    """Return a mask as run lengths, the first of which counts zeros."""
    pixels = mask.ravel(order="F")
    borders = np.flatnonzero(np.diff(pixels)) + 1
    runs = np.diff(np.concatenate([[0], borders, [pixels.size]])).tolist()
    return {"counts": [0, *runs] if pixels.size and pixels[0] else runs, "size": list(mask.shape)}


def decode_runs(
    record: object, shape: tuple[int, int], where: str
) -> Bool[np.ndarray, "height width"]:
    """Read a mask of an image of ``shape`` (height, width).

    Args:
        record: A plain JSON value that anybody may have written.
        shape: What its size must be: so a file cannot ask for more memory.
        where: Its place, for the error.

    Raises:
        UserError: The record lacks a field, has another size, or its runs do not fill the image.
    """
    fields: dict[str, Any] = record if isinstance(record, dict) else {}
    counts, size = fields.get("counts"), fields.get("size")
    if size != list(shape):
        raise _bad_bop_masks(where, f"size {size!r:.40}", f"[{shape[0]}, {shape[1]}], the image's")
    whole = isinstance(counts, list) and all(type(n) is int and n >= 0 for n in counts)
    if not whole or counts is None or sum(counts) != shape[0] * shape[1]:
        raise _bad_bop_masks(
            where,
            f"counts {counts!r:.40}",
            f"a list of run lengths that add up to {shape[0] * shape[1]} pixels",
        )
    pixels = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    return np.asarray(pixels.reshape(shape, order="F"))


def _bad_bop_masks(where: str, got: str, allowed: str) -> UserError:
    return UserError(f"{where}: {got}", allowed, "write the mask again")
