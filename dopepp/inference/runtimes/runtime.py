"""What every runtime has in common: pixels in, maps out, and an exported file's description.

The description is the checkpoint's, with how it was exported. It is one JSON text in the file's own
metadata, under ``dopepp``, so a renamed file loads the same.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Protocol

import numpy as np
import torch
from jaxtyping import Float, UInt8

from dopepp.core.errors import UserError
from dopepp.core.json import parse_json
from dopepp.core.pool import physical_cores
from dopepp.core.validation import STRICT, Range, check, parse
from dopepp.geometry.cuboid import NUM_CORNERS, NUM_KEYPOINTS
from dopepp.models.checkpoint import KEY, Checkpoint, packed, parse_description
from dopepp.models.heads import Stage
from dopepp.models.network import Images, check_spec
from dopepp.models.storage import MAX_HEADER_BYTES

INPUT: Final = "pixels"
OUTPUTS: Final = ("belief", "field")  # names in every exported graph
MAX_BYTES: Final = 2**30  # of an exported file: five times the full DOPE in float32

_MAX_PER_PIXEL: Final = 512
"""Numbers of a tensor in a graph for every pixel of its input; VGG19 has 64."""

_SECTION: Final = "export"

Count = Annotated[int, Range(0, 10**12)]

Pixels = UInt8[np.ndarray, "batch 3 height width"]
Arrays = tuple[
    Float[np.ndarray, "batch beliefs rows columns"], Float[np.ndarray, "batch fields rows columns"]
]


@dataclass(frozen=True)
class Export:
    """How a network was exported."""

    __pydantic_config__ = STRICT

    format: str  # `onnx`, `openvino` or `safetensors`
    precision: str  # `fp32`, `fp16` (weights) or `int8`
    # Image height and width must be multiples of this
    size_multiple: Annotated[int, Range(1, 1024)]
    parameters: Count  # trained numbers of the network
    # 10⁹ multiply-accumulates for one image of the training's size
    gmacs: Annotated[float, Range(0, 1e12)]
    # Share of instances with ADD below a tenth of the diameter on validation scenes, by
    # precision; where it was quantised, before and after
    add_01d: Mapping[str, Annotated[float, Range(0, 1)]] = field(default_factory=dict)
    num_images: Count = 0  # how many scenes that were


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


def pack(checkpoint: Checkpoint, export: Export) -> str:
    """Return the text for a file's metadata."""
    return packed(described(checkpoint, export)[KEY])


def described(checkpoint: Checkpoint, export: Export) -> dict[str, Any]:
    """Return a checkpoint's content (:meth:`Checkpoint.to_file`) with how it was exported."""
    content = checkpoint.to_file()
    content[KEY][_SECTION] = asdict(export)
    return content


def unpack(text: str | None, path: Path) -> tuple[Checkpoint, Export]:
    """Read a file's text, which anybody may have written; None is a file without one.

    A :class:`UserError`: it is missing, damaged, too long, of a newer version, or names what may
    not be built. Nothing is built.
    """
    if text is None or len(text) > MAX_HEADER_BYTES:
        got = "no description" if text is None else f"a description of {len(text)} characters"
        allowed = f"one of at most {MAX_HEADER_BYTES} under {KEY!r}, as `dopepp export` writes it"
        raise UserError(f"{path}: {got}", allowed, "export the checkpoint again")
    payload = parse_json(text, f"{path}, description under {KEY!r}")
    try:
        checkpoint = parse_description(payload)
        check_spec(checkpoint.spec)
        section = payload.get(_SECTION)  # type: ignore[attr-defined]
        export = parse(Export, section, _SECTION, "export the checkpoint again")
        check("stride", checkpoint.stride, int, Range(1, 256))
        if export.size_multiple % checkpoint.stride or not checkpoint.parts:
            got = f"size_multiple {export.size_multiple} and {len(checkpoint.parts)} parts"
            allowed = f"a multiple of the stride {checkpoint.stride}, and a part at least"
            raise UserError(got, allowed, "export the checkpoint again")
    except UserError as error:
        raise UserError(f"{error.got}, in {path}", error.allowed, error.fix) from error
    return checkpoint, export
