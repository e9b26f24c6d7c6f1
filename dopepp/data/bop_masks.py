"""Masks in BOP-WebDataset: run lengths down the columns, as COCO's uncompressed RLE.

``{"size": [height, width], "counts": [zeros, ones, zeros, …]}``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool

from dopepp.errors import UserError


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
        raise _bad(where, f"size {size!r:.40}", f"[{shape[0]}, {shape[1]}], the image's")
    whole = isinstance(counts, list) and all(type(n) is int and n >= 0 for n in counts)
    if not whole or counts is None or sum(counts) != shape[0] * shape[1]:
        raise _bad(
            where,
            f"counts {counts!r:.40}",
            f"a list of run lengths that add up to {shape[0] * shape[1]} pixels",
        )
    pixels = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    return np.asarray(pixels.reshape(shape, order="F"))


def _bad(where: str, got: str, allowed: str) -> UserError:
    return UserError(f"{where}: {got}", allowed, "write the mask again")
