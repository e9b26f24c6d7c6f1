"""Released checkpoints: weights in half precision and the schema, in one safetensors file.

``pretrained/NAME`` stands for a file of the package's folder ``dopepp/pretrained``. The file's
metadata hold the checkpoint's payload as JSON under ``dopepp``; nothing in it names a local path.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Final

import torch
from torch import Tensor

from dopepp.errors import UserError
from dopepp.models import safetensors_file

SUFFIX: Final = ".safetensors"
FOLDER: Final = "pretrained"

KEY: Final = "dopepp"
"""Of the description in a file, of either kind."""
_PLACES: Final = ("root", "cache_dir", "backgrounds")
"""Keys of a data configuration that name folders of the machine it was trained on."""


def released_paths() -> dict[str, Path]:
    """Return the released checkpoints by name."""
    folder = Path(__file__).parents[1] / FOLDER
    return {path.stem: path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def find(path: Path) -> Path:
    """Return the file that a path stands for: ``pretrained/NAME`` is a released checkpoint.

    Raises:
        UserError: No checkpoint of that name was released.
    """
    if path.parent != Path(FOLDER) or path.exists():
        return path
    known = released_paths()
    if path.name not in known:
        names = ", ".join(f"{FOLDER}/{name}" for name in known) or "none"
        raise UserError(f"checkpoint {path}", f"a file, or one of {names}", "correct the name")
    return known[path.name]


def read_content(path: Path) -> tuple[dict[str, Any], int]:
    """Read weights, in single precision, and payload; returns them and their size in bytes.

    Raises:
        UserError: The file is missing, damaged or foreign.
    """
    tensors, metadata = safetensors_file.read(path)
    try:
        payload = json.loads(metadata[KEY])
    except (KeyError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path} without a description under {KEY!r}",
            "a checkpoint written by `dopepp release`", "get the file again",
        ) from error  # fmt: skip
    weights = {name: _single(value) for name, value in tensors.items()}
    size = sum(value.numel() * value.element_size() for value in weights.values())
    return {"state_dict": weights, KEY: payload}, size


def write_content(content: Mapping[str, Any], path: Path) -> None:
    """Write weights in half precision and the payload without local paths.

    Args:
        content: As :meth:`dopepp.models.checkpoint.Checkpoint.to_file` returns it.
        path: The file.

    Raises:
        UserError: A weight does not fit into half precision.
        OSError: The folder cannot be written.
    """
    weights = {name: _half(name, value) for name, value in content["state_dict"].items()}
    payload = json.dumps(_portable(content[KEY]), allow_nan=False)
    safetensors_file.write(path, weights, {KEY: payload})


def _half(name: str, value: Tensor) -> Tensor:
    if not value.is_floating_point():
        return value.contiguous()
    half = value.to(torch.float16).contiguous()
    if not half.isfinite().all():
        raise UserError(
            f"{name} with values up to {float(value.abs().max()):g}",
            f"finite weights of at most {torch.finfo(torch.float16).max:g}",
            "train again: such weights come from a run that diverged",
        )
    return half


def _single(value: Tensor) -> Tensor:
    return value.float() if value.is_floating_point() else value


def _portable(value: Any, key: str = "") -> Any:
    """Return a payload in which folders of this machine are null and files have only a name."""
    if isinstance(value, Mapping):
        return {name: _portable(item, name) for name, item in value.items()}
    if isinstance(value, list):
        return [_portable(item, key) for item in value]
    if not isinstance(value, str):
        return value
    if key in _PLACES and ("/" in value or "\\" in value):
        return None
    return _file_name(value)


def _file_name(text: str) -> str:
    for kind in (PurePosixPath, PureWindowsPath):
        path = kind(text)
        if path.is_absolute() or text.startswith(("~", "..")):
            return path.name
    return text
