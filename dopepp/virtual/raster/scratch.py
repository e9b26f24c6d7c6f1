"""Working memory that serves for one image after the other.

Large arrays come from the system as fresh pages, each cleared on its first touch: 3 to 5 ms of an
image of 640×480 pixels.
"""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class _Pool(threading.local):
    """One thread's memory by name; it grows to the largest image and stays."""

    def __init__(self) -> None:
        self.blocks: dict[str, NDArray[np.uint8]] = {}


_pool = _Pool()


def scratch(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array of any content, valid until this thread asks for the same name again.

    Args:
        name: Who uses it for what; two arrays in use at a time need two names.
        shape: Of the array.
        dtype: Of its elements.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    block = _pool.blocks.get(name)
    if block is None or len(block) < size:
        block = _pool.blocks[name] = np.empty(size, np.uint8)
    return block[:size].view(dtype).reshape(shape)
