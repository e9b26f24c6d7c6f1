"""Runtimes of a network: PyTorch, or the runtime of an exported file.

The metadata of an exported file contain the checkpoint's description and the options of the export,
as one JSON text under ``dopepp``. Loading therefore does not depend on the file's name. To add a
runtime, write a module with ``read_network(path) -> ExportedNetwork`` and a line in
:data:`SUFFIXES`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final, Protocol

import numpy as np
import torch
from jaxtyping import Float, UInt8

from dopepp.core.errors import UserError
from dopepp.core.files import read_limited
from dopepp.core.json import parse_json
from dopepp.core.validation import STRICT, Range, check, parse
from dopepp.geometry.cuboid import NUM_CORNERS, NUM_KEYPOINTS
from dopepp.models.checkpoint import KEY, Checkpoint, load_network, parse_description, payload_json
from dopepp.models.heads import Stage
from dopepp.models.network import Images, PoseNetwork, check_spec
from dopepp.models.storage import MAX_HEADER_BYTES

SUFFIXES: Final = {
    ".onnx": "dopepp.inference.runtimes.onnx",
    ".xml": "dopepp.inference.runtimes.openvino",
}
"""Runtime modules by file suffix; all other files are checkpoints."""

INPUT: Final = "pixels"
OUTPUTS: Final = ("belief", "field")  # names in every exported graph
MAX_BYTES: Final = 2**30  # largest exported file: five times the full DOPE in float32

_MAX_PER_PIXEL: Final = 512
"""Largest number of tensor elements per input pixel; VGG19 has 64."""

_SECTION: Final = "export"
_FIX: Final = "export the checkpoint again"

Count = Annotated[int, Range(0, 10**12)]

Pixels = UInt8[np.ndarray, "batch 3 height width"]
Arrays = tuple[
    Float[np.ndarray, "batch beliefs rows columns"], Float[np.ndarray, "batch fields rows columns"]
]


@dataclass(frozen=True)
class Export:
    """Options of an export, and measured properties of the exported network."""

    __pydantic_config__ = STRICT

    format: str  # `onnx`, `openvino` or `safetensors`
    precision: str  # `fp32`, `fp16` (weights) or `int8`
    size_multiple: Annotated[int, Range(1, 1024)]  # divisor of image height and width
    parameters: Count  # number of trained parameters
    gmacs: Annotated[float, Range(0, 1e12)]  # 10⁹ multiply-accumulates per image of training size
    # Share of instances with ADD below a tenth of the diameter on validation scenes, by precision
    # (before and after quantisation)
    add_01d: Mapping[str, Annotated[float, Range(0, 1)]] = field(default_factory=dict)
    num_images: Count = 0  # number of those scenes


class Runtime(Protocol):
    """Computes maps from pixels; :class:`~dopepp.models.network.PoseNetwork` is a runtime.

    Attributes:
        stride: Pixels per map cell, along each axis.
        size_multiple: Divisor of image height and width.
    """

    stride: int
    size_multiple: int

    def maps(self, images: Images) -> Stage:
        """Return the belief maps, after the activation, and the vector field of RGB images."""


class ExportedNetwork(ABC):
    """An exported network, executed by another runtime than PyTorch; see :class:`Runtime`.

    Args:
        path: File, for messages.
        checkpoint: Parts, input size and thresholds of the network, without weights.
        export: Options and measurements of the export.
    """

    def __init__(self, path: Path, checkpoint: Checkpoint, export: Export) -> None:
        self.path, self.checkpoint, self.export = path, checkpoint, export
        self.stride, self.size_multiple = checkpoint.stride, export.size_multiple

    @abstractmethod
    def run(self, pixels: Pixels) -> Arrays:
        """Return the belief maps and vector fields of images."""

    def maps(self, images: Images) -> Stage:
        """Return the belief maps, after the activation, and the vector field of images.

        Args:
            images: RGB, uint8, (batch, 3, height, width); sides are multiples of ``size_multiple``.

        Raises:
            UserError: The graph fails, or its maps contradict its description.
        """
        try:
            belief, field = self.run(images.contiguous().numpy())
        except Exception as error:  # any error of the runtime, as the file is not trusted
            raise invalid_export(self.path, error) from error
        count, _, height, width = images.shape
        cells = height // self.stride, width // self.stride
        num_parts = len(self.checkpoint.parts)
        expected = [(count, n * num_parts, *cells) for n in (NUM_KEYPOINTS, 2 * NUM_CORNERS)]
        if [belief.shape, field.shape] != expected:
            problem = f"maps of shape {belief.shape} and {field.shape}"
            raise invalid_export(self.path, problem, f"{expected[0]} and {expected[1]}")
        return torch.from_numpy(belief), torch.from_numpy(field)


def is_export(path: Path) -> bool:
    """Return whether a path is an exported network (a folder or, by its suffix, a file)."""
    return path.is_dir() or path.suffix in SUFFIXES


def load(path: Path, device: torch.device) -> tuple[Runtime, Checkpoint]:
    """Load a checkpoint or an exported network (file, or OpenVINO's folder).

    Raises:
        UserError: The file is missing, damaged or not safe to load, the extra of its format is not
            installed, or the network cannot run on this device.
    """
    if not is_export(path):
        return load_network(path)
    if device.type != "cpu":
        fix = "leave out the device, or load the checkpoint that was exported"
        raise UserError(f"device {device} for {path}", "cpu for an exported network", fix)
    runtime = import_module(SUFFIXES[".xml" if path.is_dir() else path.suffix])
    exported = runtime.read_network(path)
    return exported, exported.checkpoint


def move_to_device(network: Runtime, device: torch.device) -> Runtime:
    """Return a network ready for inference; a PyTorch network is moved to the device."""
    if isinstance(network, PoseNetwork):
        network = network.for_inference().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network


def read_bytes(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Read an exported file of at most ``max_bytes``.

    Raises:
        UserError: The file is missing, unreadable or too large.
    """
    if not path.is_file():
        raise invalid_export(path, "no such file")
    try:
        return read_limited(path, max_bytes)
    except (OSError, ValueError) as error:
        raise invalid_export(path, getattr(error, "strerror", None) or error) from error


def check_shapes(path: Path, shapes: Mapping[str, Iterable[int] | None], num_pixels: int) -> None:
    """Check that no tensor of a graph has over ``_MAX_PER_PIXEL`` elements per pixel of the input.

    A few bytes of a malicious file could otherwise allocate all memory.

    Args:
        path: File, for messages.
        shapes: Shapes of the tensors by name; None if the graph does not determine a shape.
        num_pixels: Pixels of the input.

    Raises:
        UserError: A tensor is too large or has no known shape.
    """
    for name, shape in shapes.items():
        size = -1 if shape is None else int(np.prod([int(side) for side in shape], dtype=object))
        if not 0 <= size <= _MAX_PER_PIXEL * num_pixels:
            problem = "unknown size" if shape is None else f"{size} numbers"
            allowed = f"tensors of at most {_MAX_PER_PIXEL} numbers for each pixel of the input"
            raise invalid_export(path, f"tensor {name:.60} of {problem}", allowed)


def invalid_export(path: Path, problem: object, allowed: str = "") -> UserError:
    """Return the error about a file that ``dopepp export`` did not write, or that is damaged."""
    reason = " ".join(str(problem).split()) or type(problem).__name__
    return UserError(
        f"{path}: {reason:.300}",
        allowed or "a complete file written by `dopepp export`",
        f"{_FIX}; load no file that you do not trust",
    )


def pack(checkpoint: Checkpoint, export: Export) -> str:
    """Return the description of checkpoint and export as JSON, for a file's metadata."""
    return payload_json(describe_export(checkpoint, export)[KEY])


def describe_export(checkpoint: Checkpoint, export: Export) -> dict[str, Any]:
    """Return a checkpoint's content (:meth:`Checkpoint.to_file`) with an :class:`Export`."""
    content = checkpoint.to_file()
    content[KEY][_SECTION] = asdict(export)
    return content


def unpack(text: str | None, path: Path) -> tuple[Checkpoint, Export]:
    """Read the description in a file's metadata, without building the network.

    Args:
        text: Description, not trusted; None if the file has none.
        path: File, for messages.

    Raises:
        UserError: The description is missing, damaged, too long, of a newer version, or names a
            class that may not be built.
    """
    if text is None or len(text) > MAX_HEADER_BYTES:
        size = "no description" if text is None else f"a description of {len(text)} characters"
        allowed = f"at most {MAX_HEADER_BYTES} characters under {KEY!r}, written by `dopepp export`"
        raise UserError(f"{path}: {size}", allowed, _FIX)
    payload = parse_json(text, f"{path}, description under {KEY!r}")
    try:
        checkpoint = parse_description(payload)
        check_spec(checkpoint.spec)
        export = parse(Export, payload.get(_SECTION), _SECTION, _FIX)  # type: ignore[attr-defined]
        check("stride", checkpoint.stride, int, Range(1, 256))
        if export.size_multiple % checkpoint.stride or not checkpoint.parts:
            problem = f"size_multiple {export.size_multiple} and {len(checkpoint.parts)} parts"
            allowed = f"a multiple of the stride {checkpoint.stride}, and at least one part"
            raise UserError(problem, allowed, _FIX)
    except UserError as error:
        raise UserError(f"{error.got}, in {path}", error.allowed, error.fix) from error
    return checkpoint, export
