"""What every runtime has in common: pixels in, maps out, on as many threads as there are cores."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, Protocol

import numpy as np
import torch
from jaxtyping import Float, UInt8

from dopepp.core.errors import UserError
from dopepp.core.pool import physical_cores
from dopepp.geometry.cuboid import NUM_CORNERS, NUM_KEYPOINTS
from dopepp.inference.runtimes.description import Export
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.heads import Stage
from dopepp.models.network import Images

INPUT: Final = "pixels"
OUTPUTS: Final = ("belief", "field")
"""Names in every exported graph."""

MAX_BYTES: Final = 2**30
"""Of an exported file: five times the full DOPE in float32."""

_MAX_PER_PIXEL: Final = 512
"""Numbers of a tensor in a graph for every pixel of its input; VGG19 has 64."""

Pixels = UInt8[np.ndarray, "batch 3 height width"]
Arrays = tuple[
    Float[np.ndarray, "batch beliefs rows columns"], Float[np.ndarray, "batch fields rows columns"]
]


class Runtime(Protocol):
    """Turns pixels into maps; :class:`~dopepp.models.network.PoseNetwork` is one.

    Attributes:
        stride: Pixels per map cell, along each axis.
        size_multiple: Image height and width must be multiples of this.
    """

    stride: int
    size_multiple: int

    def maps(self, images: Images) -> Stage:
        """Return the belief maps, after the activation, and the vector field of RGB images."""


class ExportedNetwork(ABC):
    """A network out of a file, run by something else than PyTorch; see :class:`Runtime`.

    Args:
        path: The file, for messages.
        checkpoint: What the network was trained for, without weights.
        export: How it was exported.
    """

    def __init__(self, path: Path, checkpoint: Checkpoint, export: Export) -> None:
        self.path, self.checkpoint, self.export = path, checkpoint, export
        self.stride, self.size_multiple = checkpoint.stride, export.size_multiple

    @abstractmethod
    def run(self, pixels: Pixels) -> Arrays:
        """Return what the graph answers."""

    def maps(self, images: Images) -> Stage:
        """Return the belief maps, after the activation, and the vector field of RGB images.

        They are uint8, (batch, 3, height, width) with sides that are multiples of
        ``size_multiple``. A :class:`UserError`: the graph fails, or answers maps of another shape
        than its description says.
        """
        try:
            belief, field = self.run(images.contiguous().numpy())
        except Exception as error:  # the runtime's own, whatever the file leads to
            raise refused(self.path, error) from error
        count, _, height, width = images.shape
        cells = height // self.stride, width // self.stride
        num_parts = len(self.checkpoint.parts)
        expected = [(count, n * num_parts, *cells) for n in (NUM_KEYPOINTS, 2 * NUM_CORNERS)]
        if [belief.shape, field.shape] != expected:
            answered = f"maps of shape {belief.shape} and {field.shape}"
            raise refused(self.path, answered, f"{expected[0]} and {expected[1]}")
        return torch.from_numpy(belief), torch.from_numpy(field)


def num_threads() -> int:
    """Return ``OMP_NUM_THREADS`` where it is set, else the physical cores of this process."""
    text = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return int(text) if text.isdecimal() and int(text) > 0 else physical_cores()


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """Read a file of an export; a :class:`UserError` where it is missing or too large."""
    if not path.is_file():
        raise refused(path, "no such file")
    try:
        if path.stat().st_size > most:
            raise refused(path, f"{path.stat().st_size} bytes", f"at most {most}")
        return path.read_bytes()
    except OSError as error:
        raise refused(path, error.strerror or error) from error


def check_shapes(path: Path, shapes: Mapping[str, Iterable[int] | None], num_pixels: int) -> None:
    """Check that no tensor of a graph, for an input of so many pixels, is out of proportion.

    None is the shape of one that the graph does not say. What is wrong is a :class:`UserError`: a
    few bytes of a hostile file could ask for all memory.
    """
    for name, shape in shapes.items():
        numbers = -1 if shape is None else int(np.prod([int(side) for side in shape], dtype=object))
        if not 0 <= numbers <= _MAX_PER_PIXEL * num_pixels:
            size = "unknown size" if shape is None else f"{numbers} numbers"
            allowed = f"tensors of at most {_MAX_PER_PIXEL} numbers for each pixel of the input"
            raise refused(path, f"tensor {name:.60} of {size}", allowed)


def refused(path: Path, got: object, allowed: str = "") -> UserError:
    """Return the error about an exported file that is not as `dopepp export` writes it."""
    reason = " ".join(str(got).split()) or type(got).__name__
    return UserError(
        f"{path}: {reason:.300}",
        allowed or "a whole file written by `dopepp export`",
        "export the checkpoint again; load no file that you do not trust",
    )
