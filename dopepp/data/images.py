"""Read PNG and JPEG files strictly: an incomplete file is an error, never half an image.

OpenCV decodes a truncated file without complaint and leaves the rest grey or black.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from dopepp.errors import UserError

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG: Final = b"\xff\xd8"
_JPEG_END: Final = b"\xff\xd9"


def read_image(path: Path) -> NDArray[Any]:
    """Read an image with its own depth and channels, colours as R, G, B(, A).

    Raises:
        UserError: The file is missing, is neither PNG nor JPEG, or is incomplete or damaged.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(
            f"image {path}: {error.strerror}", "a readable file", "restore it"
        ) from error
    if content.startswith(_PNG):
        damage = _png_damage(content)
    elif content.startswith(_JPEG):
        # Cameras may append zeros or metadata after the end marker, but never cut before it.
        damage = "" if _JPEG_END in content[-64:].rstrip(b"\0") else "no end marker"
    else:
        damage = "neither PNG nor JPEG"
    image = None if damage else cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise UserError(
            f"image {path} of {len(content)} bytes: {damage or 'it cannot be decoded'}",
            "a complete PNG or JPEG file",
            "copy or download the file again",
        )
    if image.ndim == 3:
        conversion = cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
        image = cv2.cvtColor(image, conversion)
    return np.asarray(image)


def read_rgb(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Read an 8-bit colour image as RGB; an alpha channel is dropped, grey becomes three channels.

    Raises:
        UserError: As :func:`read_image`, or the image does not have 8 bits.
    """
    image = read_image(path)
    if image.dtype != np.uint8:
        raise UserError(f"image {path} of type {image.dtype}", "8 bits a channel", "convert it")
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3])


def _png_damage(content: bytes) -> str:
    """Walk the chunks (length, type, data, checksum) up to IEND; say what is wrong, if anything."""
    start = len(_PNG)
    while start + 12 <= len(content):
        length = int.from_bytes(content[start : start + 4], "big")
        end = start + 12 + length
        if end > len(content):
            break
        checksum = int.from_bytes(content[end - 4 : end], "big")
        if zlib.crc32(content[start + 4 : end - 4]) != checksum:
            return f"damaged at byte {start}"
        if content[start + 4 : start + 8] == b"IEND":
            return ""
        start = end
    return f"cut short after byte {start}"
