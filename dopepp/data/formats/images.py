"""Decode the images and masks of all layouts.

BOP's images are PNG, JPEG or TIFF; the frames and maps of YCB-Video, NDDS and FAT are PNG or JPEG.
Masks in BOP-WebDataset are run lengths down the columns, like COCO's uncompressed RLE:
``{"size": [height, width], "counts": [zeros, ones, …]}``.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dopepp.data.formats.problems import STRICT, Node, mapping
from dopepp.drawing import pictures
from dopepp.drawing.pictures import DepthMap, Mask, RGBImage, Shape

FORMATS: Final = ("PNG", "JPEG", "TIFF")  # formats of BOP's images

COLOUR_MODES: Final = ("RGB", "RGBA", "L", "LA", "P", "CMYK", "YCbCr")
"""Pillow's pixel types of BOP's colour and grey images."""

DEPTH_MODES: Final = ("I;16", "I;16B", "I", "L")
"""Pillow's pixel types of BOP's depth images: whole numbers."""

DEPTH_SCALES_MM: Final = (0.1, 1.0)
"""Millimetres per unit of written depth images, which then reach 6.5 m or 65 m."""

_MAX_UNITS: Final = 65_535


def decode_image(
    node: Node, content: bytes | None = None, modes: Sequence[str] = ()
) -> Image.Image | None:
    """Decode a BOP image; report a missing, damaged or too large image and return None.

    Args:
        node: The file or tar member.
        content: Bytes of the image; None to read the file of the node.
        modes: Pillow's names of the allowed pixel types; empty to allow all.
    """
    if content is None:
        content = node["image"].attempt(lambda: pictures.read_content(Path(node.path)))
    if content is None:
        return None
    try:
        image = pictures.whole_image(content, FORMATS)
    except ValueError as error:
        problem = f"unreadable or truncated, {len(content):,} bytes ({error})"
        most = f"{pictures.MAX_PIXELS / 1e6:.0f} megapixels"
        allowed = f"a complete {', '.join(FORMATS)} image of at most {most}"
        node["image"].report(problem, allowed)
        return None
    if modes and image.mode not in modes:
        node["image"].report(f"pixels of type {image.mode}", "colour or grey of 8 bits")
        return None
    return image


def image_shape(
    node: Node, content: bytes | None = None, modes: Sequence[str] = ()
) -> Shape | None:
    """Return an image's (height, width), or its header's if :func:`decode_image` fails, or None."""
    image = decode_image(node, content, modes)
    if image is not None:
        return image.height, image.width
    return header_shape(Path(node.path) if content is None else io.BytesIO(content))


def header_shape(file: Path | io.BytesIO) -> Shape | None:
    """Return the (height, width) in an image's header, even if truncated; None if unreadable."""
    try:
        with Image.open(file, formats=FORMATS) as image:
            width, height = image.size
    except Exception:  # damage makes Pillow raise any type
        return None
    return (height, width) if 0 < width * height <= pictures.MAX_PIXELS else None


def decode_rgb(content: bytes, where: str) -> RGBImage:
    """Decode a colour or grey image of 8 bits as RGB.

    Raises:
        UserError: The image is damaged, too large, or of another type.
    """
    image = decode_image(Node(STRICT, where), content, COLOUR_MODES)
    assert image is not None
    return np.array(image.convert("RGB"))


def decode_depth(content: bytes, where: str, depth_scale: float, shape: Shape) -> DepthMap:
    """Decode a depth image of ``depth_scale`` mm per unit as metres, float32; 0 is unknown.

    Raises:
        UserError: The image is damaged, too large, of another size or type, or the scale is NaN.
    """
    node = Node(STRICT, where)
    units = decode_one_channel(node, shape, content, DEPTH_MODES)
    assert units is not None
    if np.isnan(depth_scale):
        allowed = "depth_scale (mm per unit) next to the image's cam_K"
        node["image"].report("no depth_scale", allowed)
    return (units.astype(np.float64) * (depth_scale / 1000)).astype(np.float32)


def decode_mask(content: bytes, where: str, shape: Shape) -> Mask:
    """Decode a mask of ``shape``; the object's pixels are not 0.

    Raises:
        UserError: The image is damaged, or of another size or type.
    """
    mask = decode_one_channel(Node(STRICT, where), shape, content)
    assert mask is not None
    return np.asarray(mask != 0)


def decode_one_channel(
    node: Node, shape: Shape | None, content: bytes | None = None, modes: tuple[str, ...] = ()
) -> NDArray[Any] | None:
    """Decode a BOP depth image or mask; report an invalid image and return None.

    Args:
        node: The file or tar member.
        shape: Expected (height, width); None to allow any shape.
        content: Bytes of the image; None to read the file of the node.
        modes: Allowed Pillow modes; empty for all modes of one channel.
    """
    image = decode_image(node, content)
    if image is None:
        return None
    if len(image.getbands()) > 1 or (modes and image.mode not in modes):
        allowed = "one channel of 16-bit whole numbers" if modes else "one channel"
        node["channels"].report(f"pixels of type {image.mode}", allowed)
        return None
    return check_one_channel(node, np.asarray(image), shape)


def read_map(node: Node, shape: Shape | None, colour: bool = False) -> NDArray[Any] | None:
    """Read a map (depth, labels) of YCB-Video, NDDS or FAT; report an invalid map and return None.

    ``shape`` is the expected (height, width), or None for any. With ``colour``, a colour image,
    whose meaning is unknown, gives None without a report.
    """
    image = node["image"].attempt(lambda: pictures.read_image(Path(node.path)))
    if image is not None and image.ndim > 2 and colour:
        check_one_channel(node, image[..., 0], shape)
        return None
    return check_one_channel(node, image, shape)


def check_one_channel(
    node: Node, image: NDArray[Any] | None, shape: tuple[int, ...] | None
) -> NDArray[Any] | None:
    """Return an image of one channel and ``shape``; report any other image and return None."""
    if image is None:
        return None
    if image.ndim != 2:
        node["channels"].report(f"an image with {image.shape[2]} channels", "one channel")
        return None
    if shape is not None and image.shape != tuple(shape[:2]):
        problem = f"{image.shape[1]}×{image.shape[0]} pixels"
        node["size"].report(problem, f"{shape[1]}×{shape[0]}, the colour image's size")
        return None
    return image


def depth_units(depth: DepthMap, covered: Mask) -> tuple[NDArray[np.uint16], float]:
    """Convert metres into units of a 16-bit image; return the units and BOP's ``depth_scale``.

    The scale is the finest that covers all objects (pixels of ``covered``). Background beyond its
    range is 0 (unknown).
    """
    farthest = 1000 * float(depth[covered].max(initial=0.0))
    fine, coarse = DEPTH_SCALES_MM
    scale = fine if farthest <= _MAX_UNITS * fine else coarse
    units = np.rint(np.asarray(depth, np.float64) * (1000 / scale))
    return np.where(units <= _MAX_UNITS, units, 0).astype(np.uint16), scale


def encode_runs(mask: Mask) -> dict[str, list[int]]:
    """Encode a mask as alternating run lengths of 0 and 1, column by column, first of 0."""
    pixels = mask.ravel(order="F")
    borders = np.flatnonzero(np.diff(pixels)) + 1
    runs = np.diff(np.concatenate([[0], borders, [pixels.size]])).tolist()
    return {"counts": [0, *runs] if pixels.size and pixels[0] else runs, "size": list(mask.shape)}


def decode_runs(record: object, shape: Shape, node: Node) -> Mask | None:
    """Decode the run lengths of a mask; report invalid run lengths and return None.

    The size must be the image's ``shape``, which bounds memory.
    """
    fields = mapping(record)
    counts, size = fields.get("counts"), fields.get("size")
    are_lengths = isinstance(counts, list) and all(type(n) is int and n >= 0 for n in counts)
    if size != list(shape):
        problem = "missing" if record is None else f"size {size!r:.40}"
        node.report(problem, f"runs of the image's size [{shape[0]}, {shape[1]}]")
    elif not are_lengths or counts is None or sum(counts) != shape[0] * shape[1]:
        allowed = f"a list of run lengths that add up to {shape[0] * shape[1]} pixels"
        node.report(f"counts {counts!r:.40}", allowed)
    else:
        pixels = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
        return np.asarray(pixels.reshape(shape, order="F"))
    return None
