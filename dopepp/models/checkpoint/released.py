"""Released checkpoints: weights in half precision and the payload, in one safetensors file.

``pretrained/NAME`` stands for a file of the package's folder ``dopepp/pretrained``. The file's
metadata hold the checkpoint's payload as JSON under ``dopepp``; nothing in it names a local path.
A safetensors file is its header's length (8 bytes, little endian), the header in JSON, and bare
numbers: nothing in it can run, and the library holds every tensor to its bytes in the file.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Final

import torch
from safetensors.torch import load, save
from torch import Tensor

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.core.json import parse_json

SUFFIX: Final = ".safetensors"
FOLDER: Final = "pretrained"

KEY: Final = "dopepp"
"""Of the payload in a file, of either kind."""

MAX_BYTES: Final = 2**30
"""Of a file: five times the full DOPE in float32."""

MAX_HEADER_BYTES: Final = 16_000_000
"""Of the header with its metadata: the ADD points and meshes of forty parts as text."""

_MAX_NAME: Final = 200
"""Characters of a tensor's name or of a key of the metadata."""

_LENGTH_BYTES: Final = 8
_METADATA: Final = "__metadata__"
_FIELDS: Final = {"dtype", "shape", "data_offsets"}

_PLACES: Final = ("root", "cache_dir", "backgrounds")
"""Keys of a data configuration that name folders of the machine it was trained on."""


def released_paths() -> dict[str, Path]:
    """Return the released checkpoints by name."""
    folder = Path(__file__).parents[2] / FOLDER
    return {path.stem: path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def find(path: Path) -> Path:
    """Return the file that a path stands for: ``pretrained/NAME`` is a released checkpoint.

    If none of that name was released, it is a :class:`UserError`.
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

    A file that is missing, damaged or foreign is a :class:`UserError`.
    """
    tensors, metadata = read_safetensors(path)
    if KEY not in metadata:
        raise UserError(
            f"{path} without a description under {KEY!r}",
            "a file written by `dopepp release` or `dopepp export`", "get the file again",
        )  # fmt: skip
    payload = parse_json(metadata[KEY], f"{path}, description under {KEY!r}")
    weights = {
        name: value.float() if value.is_floating_point() else value
        for name, value in tensors.items()
    }
    size = sum(value.numel() * value.element_size() for value in weights.values())
    return {"state_dict": weights, KEY: payload}, size


def write_content(content: Mapping[str, Any], path: Path, half: bool = True) -> None:
    """Write weights, in half precision or as they are, and the payload without local paths.

    The content is as :meth:`~dopepp.models.checkpoint.schema.Checkpoint.to_file` returns it. A
    weight that does not fit into half precision is a :class:`UserError`.
    """
    weights = content["state_dict"]
    if half:
        weights = {name: _half(name, value) for name, value in weights.items()}
    write_safetensors(path, weights, {KEY: packed(content[KEY])})


def packed(payload: Mapping[str, Any]) -> str:
    """Return a payload as one line of JSON, without folders of this machine."""
    return json.dumps(_portable(payload), allow_nan=False)


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a file that anybody may have written: tensors by name, on the CPU, and the metadata.

    A file that is missing, damaged or too large, or whose header is, is a :class:`UserError`.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes")
        content = path.read_bytes()
        header = _header(content)
        tensors = load(content)
        # Here the library has found every tensor and every byte of the file to be in its place.
        entries: Any = parse_json(header, "its header")
        metadata = entries.pop(_METADATA, {})
        # It takes these four: "another field", "a long name", "no name", "metadata of a long name".
        known = all(entry.keys() == _FIELDS for entry in entries.values())
        if not known or not all(0 < len(name) <= _MAX_NAME for name in (*entries, *metadata)):
            raise ValueError(f"an unknown field, or a name not of 1 to {_MAX_NAME} characters")
    except OSError as error:
        raise _bad(path, str(error.strerror)) from error
    except UserError as error:
        raise _bad(path, error.got) from error
    except Exception as error:  # the library's own, and what a foreign header leads to
        raise _bad(path, str(error)) from error
    return tensors, metadata


def write_safetensors(
    path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> None:
    """Write a file, whole or not at all: tensors of any device and strides, metadata as texts.

    A header longer than what is read is a ``ValueError``.
    """
    plain = {name: one.detach().cpu().contiguous().clone() for name, one in tensors.items()}
    content = save(plain, dict(metadata))
    _header(content)
    write_whole(path, content)


def _header(content: bytes) -> bytes:
    """Return a file's header; the library would parse up to 100 MB of it."""
    length = int.from_bytes(content[:_LENGTH_BYTES], "little")
    if length > MAX_HEADER_BYTES:
        raise ValueError(f"a header of {length} bytes, over {MAX_HEADER_BYTES}")
    return content[_LENGTH_BYTES : _LENGTH_BYTES + length]


def _bad(path: Path, got: str) -> UserError:
    return UserError(
        f"{path}: {' '.join(got[:300].split())}",
        f"a whole safetensors file of at most {MAX_BYTES >> 20} MiB",
        "get the file again from its source",
    )


def _half(name: str, value: Tensor) -> Tensor:
    if not value.is_floating_point():
        return value
    half = value.to(torch.float16)
    if not half.isfinite().all():
        raise UserError(
            f"{name} with values up to {float(value.abs().max()):g}",
            f"finite weights of at most {torch.finfo(torch.float16).max:g}",
            "train again: such weights come from a run that diverged",
        )
    return half


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
