"""What runs a network: PyTorch, or the runtime that an exported file is for.

To add one, write a module with ``read(path) -> ExportedNetwork`` and a line in :data:`SUFFIXES`.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Final

import torch

from dopepp.core.errors import UserError
from dopepp.inference.runtimes.runtime import Runtime
from dopepp.models.checkpoint import Checkpoint, load_network
from dopepp.models.network import PoseNetwork

SUFFIXES: Final = {
    ".onnx": "dopepp.inference.runtimes.onnx",
    ".xml": "dopepp.inference.runtimes.openvino",
}
"""Module of the runtime of files with a suffix; all others are checkpoints."""


def is_export(path: Path) -> bool:
    """Tell whether a path is of an exported network, which runs on the CPU, or of a checkpoint."""
    return path.is_dir() or path.suffix in SUFFIXES


def load(path: Path, device: torch.device) -> tuple[Runtime, Checkpoint]:
    """Load a checkpoint or an exported network, with what it was trained for.

    A folder is one that `dopepp export` has written for OpenVINO. A :class:`UserError`: the file is
    missing, damaged or not safe to load, an extra is missing, or it cannot run on this device.
    """
    if not is_export(path):
        return load_network(path)
    if device.type != "cpu":
        fix = "leave the device out, or load the checkpoint that it was exported from"
        raise UserError(f"device {device} for {path}", "cpu for an exported network", fix)
    exported = import_module(SUFFIXES[".xml" if path.is_dir() else path.suffix]).read(path)
    return exported, exported.checkpoint


def placed(network: Runtime, device: torch.device) -> Runtime:
    """Return a network ready to run; one of PyTorch's is moved to the device for it."""
    if isinstance(network, PoseNetwork):
        network = network.for_inference().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network
