"""Pictures from anybody's files: decoded whole or not at all, and never larger than expected.

Every reader of photos, textures, frames, depth images and masks decodes here. Pillow refuses a file
that is cut short, where OpenCV returns the part it has, and it tells a picture's size before it
decodes it; a PNG's checksums and a JPEG's end, which it does not look at, are held to as well.

To take a further format, name it in :data:`FORMATS`, if it is nothing but pixels.
"""

from __future__ import annotations

import io
import warnings
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from dopepp.core.errors import UserError

Picture = UInt8[np.ndarray, "height width 3"]
"""RGB, first row on top."""

Size = tuple[int, int]
"""(width, height), pixels."""

Shape = tuple[int, int]
"""(height, width), as an array's."""

Mask = Bool[np.ndarray, "height width"]

DepthMap = Float[np.ndarray, "height width"]
"""Metres along z, 0 where unknown."""

FORMATS: Final = ("BMP", "JPEG", "PNG", "TGA", "TIFF", "WEBP")
"""Formats that are nothing but pixels: PIL would hand EPS to another program."""

FRAME_FORMATS: Final = ("PNG", "JPEG")
"""Formats of the frames of YCB-Video, NDDS and FAT."""

MAX_SIDE: Final = 8192
"""Pixels; such a picture takes 0.2 GB, and a small file can claim any size."""

MAX_PIXELS: Final = 64_000_000
"""Of a data set's image: twice the largest industrial cameras."""

MAX_BYTES: Final = 256_000_000
"""Of a picture's file: as many pixels as :data:`MAX_SIDE` allows, without compression."""

DARKEST: Final = 16
"""Brightest value, of 255, of 16-bit pixels that hold no more than 12 bits."""

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG: Final = b"\xff\xd8"
_JPEG_END: Final = b"\xff\xd9"


def read_picture(path: Path, longest_px: int | None = None) -> Picture:
    """Return a picture in one of :data:`FORMATS`, whatever its suffix, as RGB.

    One whose longer side is longer than ``longest_px`` is reduced; a JPEG file is then decoded at a
    fraction of its size, which takes a fraction of the time. A ValueError: it is missing, no
    picture, damaged, or over 8,192 pixels wide or high.
    """
    try:
        with _opened(_content(path), FORMATS) as image:
            if max(image.size) > MAX_SIDE:
                raise ValueError(f"{image.width}×{image.height} pixels")
            scale = 1.0 if longest_px is None else longest_px / max(image.size)
            if scale >= 1:
                return np.asarray(image.convert("RGB"))
            size = (max(round(image.width * scale), 1), max(round(image.height * scale), 1))
            image.draft("RGB", size)
            return np.asarray(image.convert("RGB").resize(size, Image.Resampling.BOX))
    except Exception as error:  # PIL raises a different type for every way to be damaged
        raise ValueError(_reason(error)) from error


def whole_picture(content: bytes, formats: tuple[str, ...] = FORMATS) -> Image.Image:
    """Decode a file that is in memory, with its own depth and channels.

    A ValueError: it is none of the formats, damaged, or larger than :data:`MAX_PIXELS`.
    """
    try:
        image = _opened(content, formats)
        if image.width * image.height > MAX_PIXELS:
            raise ValueError(f"{image.width}×{image.height} pixels")
        image.load()
    except Exception as error:  # as above
        raise ValueError(_reason(error)) from error
    return image


def read_content(path: Path) -> bytes:
    """Return an image file's bytes; a UserError where it is missing or too large."""
    try:
        return _content(path)
    except (OSError, ValueError) as error:
        reason, allowed, fix = str(error), f"at most {MAX_BYTES / 1e6:.0f} MB", "reduce it"
        if isinstance(error, OSError):
            reason, allowed, fix = str(error.strerror), "a readable file", "restore it"
        raise UserError(f"image {path}: {reason}", allowed, fix) from error


def read_image(path: Path) -> NDArray[Any]:
    """Read a frame with its own depth and channels, colours as R, G, B(, A).

    A UserError: the file is missing, is neither PNG nor JPEG, is incomplete or damaged, or has
    colours of 16 bits.
    """
    content = read_content(path)
    try:
        image = whole_picture(content, FRAME_FORMATS)
    except ValueError as error:
        raise UserError(
            f"image {path} of {len(content)} bytes: {error}",
            "a complete PNG or JPEG file",
            "copy or download the file again",
        ) from error
    if _is_deep_colour(content):
        # Pillow would drop their lower half without a word.
        raise UserError(f"image {path} of 16-bit colours", "8 bits a channel", "convert it")
    if image.mode.startswith("I"):
        return np.asarray(image, np.uint16)
    if image.mode not in ("L", "RGB", "RGBA"):
        # Palettes, greys with alpha, one bit a pixel, print colours.
        plain = "L" if image.mode == "1" else "RGBA" if image.has_transparency_data else "RGB"
        image = image.convert(plain)
    return np.asarray(image)


def read_rgb(path: Path) -> Picture:
    """Read an 8-bit frame as RGB; an alpha channel is dropped, grey becomes three channels.

    A UserError, as from :func:`read_image`, also where the image does not have 8 bits.
    """
    image = read_image(path)
    if image.dtype != np.uint8:
        raise UserError(f"image {path} of type {image.dtype}", "8 bits a channel", "convert it")
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3])


def read_photo(path: Path) -> Picture:
    """Read what a camera or a person has saved as RGB, upright: as OpenCV reads it, and no less.

    The format is one of :data:`FORMATS`. An EXIF orientation is applied, an alpha channel dropped;
    grey becomes three channels. Of 16 bits the upper eight are taken.

    A UserError: the file is missing, damaged or too large, none of the formats or one of several
    pages, its values are not 8 or 16 bits, or its 16 bits hold so little that nothing is left.
    """
    allowed = "a picture (PNG, JPEG, TIFF, BMP, WEBP) of 8 or 16 bits a channel"
    save = f"save it as PNG, e.g. with ImageMagick: magick {path.name} picture.png"
    content = read_content(path)
    try:
        image = whole_picture(content)
        is_grey16 = image.mode.startswith("I") and _is_deep(image, content)
        if getattr(image, "n_frames", 1) > 1 or (image.mode[0] in "IF" and not is_grey16):
            raise ValueError(f"of mode {image.mode}, {getattr(image, 'n_frames', 1)} pages")
        is_deep = _is_deep(image, content)
        image = ImageOps.exif_transpose(image)
    except Exception as error:  # PIL raises a different type for every way to be damaged
        raise UserError(f"image {path}: {_reason(error)}", allowed, save) from error
    if is_grey16:
        picture = np.repeat((np.asarray(image, np.uint16) >> 8)[..., None], 3, 2).astype(np.uint8)
    else:  # of 16-bit colours, Pillow has taken the upper eight itself
        picture = np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))
    if is_deep and picture[..., :3].max() < DARKEST:
        raise UserError(
            f"image {path} of 16 bits, the brightest of which is {picture[..., :3].max()} of 255",
            "16 bits that are used, not 10 or 12 of a sensor's",
            f"stretch it: magick {path.name} -auto-level -depth 8 picture.png",
        )
    return np.ascontiguousarray(picture[..., :3])


def _content(path: Path) -> bytes:
    with path.open("rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"more than {MAX_BYTES / 1e6:.0f} MB")
    return content


def _opened(content: bytes, formats: tuple[str, ...]) -> Image.Image:
    """Open a picture and hold it to its format, without decoding it."""
    damage = "" if content else "an empty file"
    if content.startswith(_PNG):
        damage = _png_damage(content)
    elif content.startswith(_JPEG) and _JPEG_END not in content:
        damage = "no end marker"  # behind which cameras append anything
    if damage:
        raise ValueError(f"truncated or damaged, {damage}")
    with warnings.catch_warnings():
        # Of a picture above its limit PIL warns, in a line of its own; ours are lower.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            return Image.open(io.BytesIO(content), formats=formats)
        except UnidentifiedImageError:
            # PIL's own text shows an address in memory.
            listed = ", ".join(formats)
            raise ValueError(f"cannot identify the format, none of {listed}") from None


def _png_damage(content: bytes) -> str:
    """Walk the chunks (length, type, data, checksum) up to IEND; say what is wrong, if anything."""
    start = len(_PNG)
    while start + 12 <= len(content):
        length = int.from_bytes(content[start : start + 4], "big")
        end = start + 12 + length
        if end > len(content):
            break
        checksum = int.from_bytes(content[end - 4 : end], "big")
        if zlib.crc32(memoryview(content)[start + 4 : end - 4]) != checksum:
            return f"damaged at byte {start}"
        if content[start + 4 : start + 8] == b"IEND":
            return ""
        start = end
    return f"cut short after byte {start}"


def _is_deep_colour(content: bytes) -> bool:
    """Tell whether a PNG's header (behind signature, length, type and size) says 16-bit colour."""
    return content.startswith(_PNG) and content[24] == 16 and content[25] != 0


def _is_deep(image: Image.Image, content: bytes) -> bool:
    """Tell whether a picture has 16 bits a channel, by a PNG's header or a TIFF's entry."""
    bits = getattr(image, "tag_v2", {}).get(ExifTags.Base.BitsPerSample, (8,))
    return max(bits) == 16 or (content.startswith(_PNG) and content[24] == 16)


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
