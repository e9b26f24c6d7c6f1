"""Image and video files: strict decoding of images, and crash-safe writing of videos.

This module decodes all photos, textures, frames, depth images and masks; a damaged file is an
error. Pillow, unlike OpenCV, rejects truncated files and reports the size before decoding. The
checksums of a PNG and the end of a JPEG are checked here. To accept a further raster format, add
its name to :data:`FORMATS`.

Labels and texture coordinates refer to stored pixels, so labelled images (:func:`read_image`,
:func:`read_rgb`) and textures ignore the EXIF orientation. Photos without labels are turned upright
(:func:`read_photo`, :func:`read_picture`).
"""

from __future__ import annotations

import io
import os
import shutil
import warnings
import zlib
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from dopepp.core.errors import RunError, UserError
from dopepp.core.files import partial_path, read_limited

# OpenCV reads this once, before its first video: FFmpeg must not write to the terminal.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

RGBImage = UInt8[np.ndarray, "height width 3"]  # RGB image, 8 bits per channel, first row on top

Size = tuple[int, int]  # (width, height), pixels

Shape = tuple[int, int]  # (height, width) of an image array, pixels

Mask = Bool[np.ndarray, "height width"]

DepthMap = Float[np.ndarray, "height width"]
"""Depth along the optical axis in metres; 0 for unknown."""

FORMATS: Final = ("BMP", "JPEG", "PNG", "TGA", "TIFF", "WEBP")
"""Accepted raster formats by Pillow's names; for EPS, Pillow would start another program."""

FRAME_FORMATS: Final = ("PNG", "JPEG")  # Formats of the frames of YCB-Video, NDDS and FAT data sets

MAX_SIDE: Final = 8192
"""Longest side of a picture, pixels: 0.2 GB in memory. A small file can declare any size."""

MAX_PIXELS: Final = 64_000_000
"""Largest number of pixels of a data set's image: twice that of the largest industrial cameras."""

MAX_BYTES: Final = 256_000_000
"""Largest size of an image file: the pixels that :data:`MAX_SIDE` allows, without compression."""

DARKEST: Final = 16
"""Smallest valid maximum (of 255) of a 16-bit image; values of 12 bits stay below."""

MIN_FREE: Final = 16_000_000
"""Free bytes on the disk below which the writing of a video stops, so that it can be closed."""

USUAL_RATE: Final = 25.0
"""Assumed frames per second of a video or camera that does not state its rate."""

LONGEST_GAP_S: Final = 2.0
"""Longest time for which a video repeats an image if the next image is late, seconds."""

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG: Final = b"\xff\xd8"
_JPEG_END: Final = b"\xff\xd9"


def read_picture(path: Path, longest_px: int | None = None, *, upright: bool = True) -> RGBImage:
    """Read an image in one of :data:`FORMATS` as RGB; of 16 bits, the upper eight are kept.

    Images with a side above ``longest_px`` are downscaled; a JPEG is then decoded at a reduced
    size, which is faster. ``upright`` applies the EXIF orientation.

    Raises:
        ValueError: The file is missing, damaged or not an image, exceeds :data:`MAX_SIDE`, or its
            values do not have 8 or 16 bits.
    """
    try:
        content = read_limited(path, MAX_BYTES)
        with _open(content, FORMATS) as image:
            if max(image.size) > MAX_SIDE:
                raise ValueError(f"{image.width}×{image.height} pixels")
            scale = 1.0 if longest_px is None else longest_px / max(image.size)
            if scale >= 1:
                pixels = as_rgb(image, content)
            else:
                size = (max(round(image.width * scale), 1), max(round(image.height * scale), 1))
                image.draft("RGB", size)
                pixels = as_rgb(image, content).resize(size, Image.Resampling.BOX)
            if upright:
                ImageOps.exif_transpose(pixels, in_place=True)
            return np.asarray(pixels)
    except Exception as error:  # PIL raises a different type for every way to be damaged
        raise ValueError(_reason(error)) from error


def as_rgb(image: Image.Image, content: bytes) -> Image.Image:
    """Return an image with the file's ``content`` as 8-bit RGB; of 16 bits, the upper eight.

    Raises:
        ValueError: The values do not have 8 or 16 bits.
    """
    if image.mode[0] not in "IF":  # Pillow keeps the upper eight of 16 bits in colours only
        return image.convert("RGB")
    if not _is_deep(image, content):
        raise ValueError(f"values of mode {image.mode}, not of 8 or 16 bits")
    grey = Image.fromarray(_upper_eight(image))
    grey.info = image.info
    return grey.convert("RGB")


def _upper_eight(image: Image.Image) -> UInt8[np.ndarray, "height width"]:
    """Return the upper eight bits of a 16-bit grey image."""
    return (np.asarray(image, np.uint16) >> 8).astype(np.uint8)


def whole_image(content: bytes, formats: tuple[str, ...] = FORMATS) -> Image.Image:
    """Decode an image file's content with the file's bit depth and channels.

    Raises:
        ValueError: The format is none of ``formats``, the content is damaged, or the image exceeds
            :data:`MAX_PIXELS`.
    """
    try:
        image = _open(content, formats)
        if image.width * image.height > MAX_PIXELS:
            raise ValueError(f"{image.width}×{image.height} pixels")
        image.load()
    except Exception as error:  # decoders raise several types
        raise ValueError(_reason(error)) from error
    return image


def read_content(path: Path) -> bytes:
    """Return an image file's bytes.

    Raises:
        UserError: The file is missing, unreadable or larger than :data:`MAX_BYTES`.
    """
    try:
        return read_limited(path, MAX_BYTES)
    except (OSError, ValueError) as error:
        reason, allowed = str(error), f"at most {MAX_BYTES / 1e6:.0f} MB"
        fix = "save the image with fewer pixels"
        if isinstance(error, OSError):
            reason, allowed = str(error.strerror), "a readable file"
            fix = "pass the path of an existing file, or make it readable"
        raise UserError(f"image {path}: {reason}", allowed, fix) from error


def read_image(path: Path) -> NDArray[Any]:
    """Read a PNG or JPEG with the file's bit depth and channels, colours as R, G, B(, A).

    Raises:
        UserError: The file is missing, damaged, of another format, or has 16-bit colours.
    """
    content = read_content(path)
    try:
        image = whole_image(content, FRAME_FORMATS)
    except ValueError as error:
        raise UserError(
            f"image {path} of {len(content)} bytes: {error}",
            "a complete PNG or JPEG file",
            "copy or download the file again",
        ) from error
    if _is_deep_colour(content):
        # Pillow would silently drop the lower half of the bits.
        fix = f"convert it: magick {path.name} -depth 8 image.png"
        raise UserError(f"image {path} of 16-bit colours", "8 bits per channel", fix)
    if image.mode.startswith("I"):
        return np.asarray(image, np.uint16)
    if image.mode not in ("L", "RGB", "RGBA"):
        # Palettes, greys with alpha, one bit per pixel, print colours.
        plain = "L" if image.mode == "1" else "RGBA" if image.has_transparency_data else "RGB"
        image = image.convert(plain)
    return np.asarray(image)


def read_rgb(path: Path) -> RGBImage:
    """Read an 8-bit PNG or JPEG as RGB; alpha is dropped, grey becomes three channels.

    Raises:
        UserError: As for :func:`read_image`, or the image does not have 8 bits per channel.
    """
    image = read_image(path)
    if image.dtype != np.uint8:
        fix = f"convert it: magick {path.name} -depth 8 image.png"
        raise UserError(f"image {path} of type {image.dtype}", "8 bits per channel", fix)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3])


def read_photo(path: Path) -> RGBImage:
    """Read an image in one of :data:`FORMATS` as upright 8-bit RGB, with the values of OpenCV.

    The EXIF orientation is applied, alpha dropped, grey repeated, and 16 bits cut to the upper 8.

    Raises:
        UserError: The file is missing, damaged, too large, of another format or multi-page, its
            values do not have 8 or 16 bits, or its 16-bit values are too dark.
    """
    allowed = "an image (PNG, JPEG, TIFF, BMP, WEBP) of 8 or 16 bits a channel"
    save = f"save it as PNG, e.g. with ImageMagick: magick {path.name} image.png"
    content = read_content(path)
    try:
        image = whole_image(content)
        is_grey16 = image.mode.startswith("I") and _is_deep(image, content)
        if getattr(image, "n_frames", 1) > 1 or (image.mode[0] in "IF" and not is_grey16):
            raise ValueError(f"of mode {image.mode}, {getattr(image, 'n_frames', 1)} pages")
        is_deep = _is_deep(image, content)
        image = ImageOps.exif_transpose(image)
    except Exception as error:  # PIL raises many types for damaged files
        raise UserError(f"image {path}: {_reason(error)}", allowed, save) from error
    if is_grey16:
        pixels = np.repeat(_upper_eight(image)[..., None], 3, 2)
    else:  # Pillow keeps the upper eight of 16 bits in colours
        pixels = np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))
    if is_deep and pixels[..., :3].max() < DARKEST:
        brightest = pixels[..., :3].max() / 255
        raise UserError(
            f"image {path} of 16 bits, whose largest value is {brightest:.1%} of white",
            "values that use all 16 bits, not only 10 or 12 bits",
            f"stretch it: magick {path.name} -auto-level -depth 8 image.png",
        )
    return np.ascontiguousarray(pixels[..., :3])


def photo_size(path: Path) -> Size:
    """Return the size of :func:`read_photo`'s image from the header of the file.

    Raises:
        UserError: As for :func:`read_photo`, if the header is damaged.
    """
    try:
        image = _open(read_content(path), FORMATS)
        # Pillow states the size of a TIFF file after its rotation.
        is_turned = image.format != "TIFF" and image.getexif().get(ExifTags.Base.Orientation, 1) > 4
    except Exception:  # PIL raises many types for damaged files; read_photo names the damage
        height, width, _ = read_photo(path).shape
        return width, height
    return image.size[::-1] if is_turned else image.size


def _open(content: bytes, formats: tuple[str, ...]) -> Image.Image:
    """Open an image without decoding; raise a ``ValueError`` for a damaged or unknown file."""
    damage = "" if content else "an empty file"
    if content.startswith(_PNG):
        damage = _png_damage(content)
    elif content.startswith(_JPEG) and _JPEG_END not in content:
        damage = "no end marker"  # cameras may append data after the marker
    if damage:
        raise ValueError(f"truncated or damaged, {damage}")
    with warnings.catch_warnings():
        # Our limits are lower than the limit of this warning.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            return Image.open(io.BytesIO(content), formats=formats)
        except UnidentifiedImageError:
            # PIL's message contains a memory address.
            listed = ", ".join(formats)
            raise ValueError(f"cannot identify the format, none of {listed}") from None


def _png_damage(content: bytes) -> str:
    """Return where a PNG's chunks are damaged or end before IEND, or an empty string."""
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
    """Return whether a file is a PNG with 16-bit colours, from bytes 24 and 25 of its header."""
    return content.startswith(_PNG) and content[24] == 16 and content[25] != 0


def _is_deep(image: Image.Image, content: bytes) -> bool:
    """Return whether the header of a PNG or a tag of a TIFF declares 16 bits per channel."""
    bits = getattr(image, "tag_v2", {}).get(ExifTags.Base.BitsPerSample, (8,))
    return max(bits) == 16 or (content.startswith(_PNG) and content[24] == 16)


def _reason(error: Exception) -> str:
    """Return an exception's message on one line, or its type if it has no message."""
    return " ".join(str(error).split()) or type(error).__name__


class VideoFile(AbstractContextManager["VideoFile"]):
    """Writer of an MP4 file (MPEG-4 part 2), which is a partial file until it is closed.

    Images are repeated or dropped to match their times, and resized to the first image's size.
    Odd sides are padded by one pixel, as the format requires even sides.

    The suffix is ``.mp4``; ``rate`` is in frames per second.
    """

    def __init__(self, path: Path, rate: float) -> None:
        self.path, self._rate = path, rate
        partial = partial_path(path)
        self._partial = partial.with_name(partial.name + path.suffix)
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self._start = 0.0
        self._written = 0

    def write(self, image: RGBImage, time: float) -> None:
        """Add an image that was taken at ``time``, seconds from any origin.

        Raises:
            RunError: The disk is full, or this OpenCV cannot write MP4.
        """
        height, width = image.shape[:2]
        even = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), "edge")
        if self._writer is None:
            self._size, self._start = (even.shape[1], even.shape[0]), time
            code = cv2.VideoWriter.fourcc(*"mp4v")
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = cv2.VideoWriter(
                str(self._partial), cv2.CAP_FFMPEG, code, self._rate, self._size
            )
            if not self._writer.isOpened():
                raise RunError(f"{self.path}: this OpenCV cannot write MP4 videos")
        if (even.shape[1], even.shape[0]) != self._size:
            even = np.asarray(cv2.resize(even, self._size, interpolation=cv2.INTER_AREA))
        until = round((time - self._start) * self._rate) + 1
        if (late := until - self._written - max(1, round(LONGEST_GAP_S * self._rate))) > 0:
            until -= late
            self._start += late / self._rate  # the images that follow are not late
        if self._written < until and shutil.disk_usage(self.path.parent).free < MIN_FREE:
            raise RunError(f"no space left for {self.path}; delete files on this disk")
        frame = cv2.cvtColor(even, cv2.COLOR_RGB2BGR)
        while self._written < until:
            self._writer.write(frame)
            self._written += 1

    def close(self) -> None:
        """Close the partial file, rename it to the final path and check its number of frames.

        Raises:
            RunError: The file has fewer frames than were written.
        """
        if self._writer is None:
            return
        self._writer.release()
        self._writer = None
        num_saved = 0
        if self._written:
            reader = cv2.VideoCapture(str(self._partial), cv2.CAP_FFMPEG)
            num_saved = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
            reader.release()
        if num_saved:
            self._partial.replace(self.path)
        self._partial.unlink(missing_ok=True)
        if num_saved < self._written:
            frames = f"{num_saved} of {self._written} frames"
            raise RunError(f"{self.path}: only {frames} were saved; is the disk full?")

    def __exit__(self, *_: object) -> None:
        self.close()
