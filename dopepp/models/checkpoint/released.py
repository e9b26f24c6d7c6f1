"""Released checkpoints: weights in half precision and the schema, in one safetensors file.

``pretrained/NAME`` stands for a file of the package's folder ``dopepp/pretrained``. The file's
metadata hold the checkpoint's payload as JSON under ``dopepp``; nothing in it names a local path.

Weights as safetensors: a JSON header and bare numbers, in which nothing can be hidden.

A file is the header's length (8 bytes, little endian), the header ``{name: {"dtype", "shape",
"data_offsets"}, …, "__metadata__": {text: text}}``, and the tensors' bytes one after the other.
The library that parses it bounds neither what it parses nor the text of the metadata, and its
errors are not a user's; so the header is held to the file here before the library sees it.

To allow a further type of number, name it in :data:`DTYPES`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Final, NoReturn

import torch
from safetensors.torch import load, save
from torch import Tensor

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.models.checkpoint import released as safetensors_file

DTYPES: Final = {
    "BOOL": torch.bool,
    "U8": torch.uint8,
    "I8": torch.int8,
    "I16": torch.int16,
    "I32": torch.int32,
    "I64": torch.int64,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "F32": torch.float32,
    "F64": torch.float64,
}
"""Types of number, by the format's names."""

MAX_BYTES: Final = 2**30
"""Of a file: five times the full DOPE in float32."""

MAX_HEADER_BYTES: Final = 8_000_000
"""Of the header with its metadata: the ADD points of forty parts as text."""

MAX_NAME: Final = 200
"""Characters of a tensor's name or of a key of the metadata."""

MAX_DIMENSIONS: Final = 8

METADATA: Final = "__metadata__"
_LENGTH_BYTES: Final = 8
_FIELDS: Final = frozenset({"dtype", "shape", "data_offsets"})


def write(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a file, whole or not at all.

    Args:
        path: The file.
        tensors: By name, on any device, of any strides.
        metadata: What else the file says, text by name.

    Raises:
        ValueError: :func:`read` would refuse the file.
        OSError: The folder cannot be written.
    """
    plain = {name: one.detach().cpu().contiguous().clone() for name, one in tensors.items()}
    content = save(plain, dict(metadata))
    _header(content)
    write_whole(path, content)


def read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a file that anybody may have written.

    Returns:
        The tensors by name, on the CPU, and the metadata.

    Raises:
        UserError: The file is missing or too large, or its header is damaged, too long, not
            within bounds, or does not account for every byte of the file once.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes")
        content = path.read_bytes()
        metadata = _header(content)
        return dict(load(content)), metadata
    except OSError as error:
        raise _bad(path, str(error.strerror)) from error
    except ValueError as error:
        raise _bad(path, str(error)) from error
    except Exception as error:  # the library's own, for what it alone finds
        raise _bad(path, f"{type(error).__name__}: {error}") from error


def _header(content: bytes) -> dict[str, str]:
    """Check a file's header against its size and return the metadata."""
    length = int.from_bytes(content[:_LENGTH_BYTES], "little")
    start = _LENGTH_BYTES + length
    if len(content) < _LENGTH_BYTES or start > len(content):
        raise ValueError(f"a header of {length} bytes in a file of {len(content)}")
    if length > MAX_HEADER_BYTES:
        raise ValueError(f"a header of {length} bytes, over {MAX_HEADER_BYTES}")
    header = _parsed(content[_LENGTH_BYTES:start])
    metadata = _metadata(header.pop(METADATA, {}))
    spans = sorted(_span(name, entry) for name, entry in header.items())
    end = 0
    for first, last, name in spans:
        if first != end:
            problem = "a gap before it" if first > end else "bytes of another one"
            raise ValueError(f"tensor {name!r:.80} with {problem}")
        end = last
    if start + end != len(content):
        raise ValueError(f"tensors of {end} bytes, {len(content) - start} in the file")
    return metadata


def _parsed(header: bytes) -> dict[str, Any]:
    try:
        parsed = json.loads(
            header.decode(), object_pairs_hook=_object, parse_constant=_refuse_constant
        )
    except RecursionError as error:
        raise ValueError("a header nested too deep") from error
    if not isinstance(parsed, dict):
        raise ValueError(f"a header that is a {type(parsed).__name__}")
    return parsed


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ValueError("a header with a name twice")
    return fields


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"a header with {text}")


def _metadata(metadata: object) -> dict[str, str]:
    plain = isinstance(metadata, dict) and all(
        len(key) <= MAX_NAME and isinstance(value, str) for key, value in metadata.items()
    )
    if not plain:
        raise ValueError(f"{METADATA} that is not text by names of up to {MAX_NAME} characters")
    return dict(metadata)  # type: ignore[call-overload, no-any-return]


def _span(name: str, entry: object) -> tuple[int, int, str]:
    """Return a tensor's first byte, the one after its last, and its name."""
    where = f"tensor {name!r:.80}"
    if not 0 < len(name) <= MAX_NAME or not isinstance(entry, dict) or {*entry} != _FIELDS:
        raise ValueError(f"{where} that is no {', '.join(sorted(_FIELDS))}, or has a long name")
    kind, shape, offsets = entry["dtype"], entry["shape"], entry["data_offsets"]
    if not isinstance(kind, str) or kind not in DTYPES:
        raise ValueError(f"{where} of numbers {kind!s:.50}, none of {', '.join(DTYPES)}")
    if not _are_sizes(shape, MAX_DIMENSIONS):
        raise ValueError(f"{where} of a shape that is none")
    if not _are_sizes(offsets, 2) or len(offsets) != 2:
        raise ValueError(f"{where} with data_offsets that are not [first, last]")
    size = math.prod(shape) * DTYPES[kind].itemsize
    if offsets[1] - offsets[0] != size:
        raise ValueError(f"{where} of {size} bytes in {offsets[1] - offsets[0]}")
    return offsets[0], offsets[1], name


def _are_sizes(value: object, most: int) -> bool:
    """Tell whether a value is a short list of whole numbers no larger than a file."""
    return (
        isinstance(value, list)
        and len(value) <= most
        and all(type(number) is int and 0 <= number <= MAX_BYTES for number in value)
    )


def _bad(path: Path, got: str) -> UserError:
    return UserError(
        f"{path}: {got:.300}",
        f"a whole safetensors file of at most {MAX_BYTES >> 20} MiB",
        "get the file again from its source",
    )


SUFFIX: Final = ".safetensors"
FOLDER: Final = "pretrained"

KEY: Final = "dopepp"
"""Of the description in a file, of either kind."""
_PLACES: Final = ("root", "cache_dir", "backgrounds")
"""Keys of a data configuration that name folders of the machine it was trained on."""


def released_paths() -> dict[str, Path]:
    """Return the released checkpoints by name."""
    folder = Path(__file__).parents[2] / FOLDER
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
        content: As :meth:`dopepp.models.checkpoint.schema.Checkpoint.to_file` returns it.
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
