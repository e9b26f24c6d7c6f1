"""Self-describing checkpoints, read under ``weights_only=True``.

A ``.ckpt`` is a Lightning checkpoint, or has only two of its keys: ``state_dict`` holds the
weights, prefixed ``network.``, and ``dopepp`` the description of the pose estimator. A released
``.safetensors`` holds the weights in half precision and the description as JSON in its metadata.
``pretrained/NAME`` names a file in the folder ``dopepp/pretrained``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, Final

import numpy as np
import torch
from torch import Tensor

from dopepp.core.errors import UserError
from dopepp.core.json import parse_json
from dopepp.core.validation import Range, parse
from dopepp.models.network import PoseNetwork, architecture, build_network
from dopepp.models.storage import (
    check_container,
    read_mapping,
    read_safetensors,
    write_safetensors,
)
from dopepp.parts.part import Part
from dopepp.parts.size import LearnedRange

KEY: Final = "dopepp"  # Key of the description in files of both kinds

STATE_PREFIX: Final = "network."
FORMAT_VERSION: Final = 2

SUFFIX: Final = ".safetensors"
FOLDER: Final = "pretrained"

MAX_SIDE: Final = 8192  # Pixels; images are enlarged to the input size, which determines memory

_MAX_VALUES: Final = 4_000_000
_MAX_DEPTH: Final = 32
_MAX_BITS: Final = 128
"""Limits of values, nesting levels and bits of integers, above the needs of real descriptions."""

_FOLDER_KEYS: Final = ("root", "cache_dir", "backgrounds")
"""Keys of a data configuration that name folders of the training machine."""

_KIND: Final = "a checkpoint (.ckpt) written by train.py"
_FIX: Final = "use a checkpoint written by train.py"


@dataclass(eq=False)
class Checkpoint:
    """A trained network with everything needed to use it."""

    spec: dict[str, Any]  # of `dopepp.models.network`, without `weights_path`
    state_dict: dict[str, Tensor]  # weights by name, without prefix
    parts: list[Part]  # in channel order
    input_size: tuple[int, int]  # (width, height) of training images, pixels
    stride: int  # pixels per map cell
    sigma: float  # standard deviation of the belief targets, cells
    recovery: dict[str, float] = field(default_factory=dict)  # options, as of RecoveryOptions
    data: dict[str, Any] = field(default_factory=dict)  # data and camera configuration
    data_fingerprint: str = ""  # hash of everything that determines the training data
    seen: dict[str, LearnedRange] = field(default_factory=dict)  # trained sizes, by part name

    def to_payload(self) -> dict[str, Any]:
        """Return the description as JSON values; a ``TypeError`` rejects other values."""
        names = ("input_size", "stride", "sigma", "recovery", "data", "data_fingerprint", "seen")
        values = {
            "format_version": FORMAT_VERSION,
            "spec": architecture(self.spec),
            "parts": [part.to_record() for part in self.parts],
            **{name: getattr(self, name) for name in names},
        }
        payload: dict[str, Any] = json.loads(json.dumps(values, default=_from_numpy))
        return payload

    def to_file(self) -> dict[str, Any]:
        """Return the content of a ``.ckpt`` file: weights and description, no training state."""
        weights = {STATE_PREFIX + name: value for name, value in self.state_dict.items()}
        return {"state_dict": weights, KEY: self.to_payload()}


@dataclass(frozen=True)
class _Header:
    """The fields of a description except the version; unknown fields are ignored."""

    spec: dict[str, Any]
    parts: list[Any]
    data: dict[str, Any]
    input_size: Annotated[tuple[int, int], Range(1, MAX_SIDE, "pixels")]
    stride: Annotated[int, Range(1, 256, "pixels")]
    sigma: Annotated[float, Range(0.1, 100, "cells")]
    recovery: dict[str, int | float]
    data_fingerprint: str
    seen: dict[str, Any]


def read(path: Path) -> Checkpoint:
    """Read a checkpoint (a file or ``pretrained/NAME``) and compare its weights with its spec.

    Raises:
        UserError: The file is missing, damaged, too large, inconsistent, of another version or
            not a checkpoint, or its spec names a class that is not allowed.
    """
    path = find(Path(path))
    if path.suffix == SUFFIX:
        content, size = _read_released(path)
    else:
        size = check_container(path, _KIND)
        content = read_mapping(path, _KIND)
    if KEY not in content:
        raise UserError(f"{path} without {KEY!r} entry", _KIND, _FIX)
    try:
        checkpoint = parse_description(content[KEY])
        weights = content.get("state_dict")
        if not isinstance(weights, dict):
            raise UserError(f"state_dict as {type(weights).__name__}", "weights by name", _FIX)
        checkpoint.state_dict = {
            name.removeprefix(STATE_PREFIX): value
            for name, value in weights.items()
            if isinstance(name, str) and name.startswith(STATE_PREFIX)
        }
        _check_weights(checkpoint, size)
    except UserError as error:
        raise UserError(f"{error.got}, in checkpoint {path}", error.allowed, error.fix) from error
    return checkpoint


def load_network(path: Path) -> tuple[PoseNetwork, Checkpoint]:
    """Return the network of a checkpoint, in evaluation mode on the CPU, and the checkpoint."""
    checkpoint = read(path)
    network = build_network(checkpoint.spec)
    network.load_state_dict(checkpoint.state_dict)
    return network.eval(), checkpoint


def parse_description(payload: object) -> Checkpoint:
    """Parse the result of :meth:`Checkpoint.to_payload` into a checkpoint without weights."""
    if not isinstance(payload, dict):
        problem = f"a description of type {type(payload).__name__}"
        raise UserError(problem, "a mapping", "train the network again")
    _check_plain(payload)
    version = payload.get("format_version")
    if type(version) is not int or version != FORMAT_VERSION:
        fix = "use the version of dopepp that wrote the file, or train again"
        raise UserError(f"format_version {version!r:.100}", f"{FORMAT_VERSION}", fix)
    # Containers with their own parser are not copied; empty containers replace them here.
    kept = {name: payload[name] for name in ("spec", "parts", "data") if name in payload}
    empty = {name: type(value)() for name, value in kept.items() if isinstance(value, (dict, list))}
    fields = vars(parse(_Header, {**payload, **empty}, fix=_FIX))
    parts = [Part.from_record(record) for record in kept["parts"]]
    seen = {name: LearnedRange.parse(values) for name, values in fields["seen"].items()}
    kept |= {"spec": architecture(kept["spec"]), "parts": parts, "seen": seen}
    return Checkpoint(**{**fields, **kept}, state_dict={})


def _check_plain(payload: Mapping[Any, Any]) -> None:
    """Reject values that are no JSON values, too deeply nested or too many, repeats included."""
    counts: dict[int, int] = {}
    for name, value in payload.items():
        try:
            _count(value, 0, counts)
        except ValueError as error:
            allowed = "mappings, lists, text, numbers, true/false and null"
            raise UserError(f"{name!s:.50} with {error}", allowed, _FIX) from error


def _count(value: object, depth: int, counts: dict[int, int]) -> int:
    """Return the number of JSON values in a value; ``counts`` caches containers by id."""
    if type(value) not in (dict, list, tuple):
        if isinstance(value, int) and value.bit_length() > _MAX_BITS:
            raise ValueError(f"an integer of {value.bit_length()} bits")
        if type(value) not in (str, int, float, bool, type(None)):
            raise ValueError(f"a {type(value).__name__}")
        return 1
    if id(value) not in counts:
        if depth == _MAX_DEPTH:
            raise ValueError(f"more than {_MAX_DEPTH} levels of nesting")
        items: Iterable[object] = value  # type: ignore[assignment]
        if isinstance(value, dict):
            odd = next((key for key in value if type(key) not in (str, int)), None)
            if odd is not None:
                raise ValueError(f"a key of type {type(odd).__name__}")
            items = value.values()
        counts[id(value)] = 1 + sum(_count(item, depth + 1, counts) for item in items)
    if counts[id(value)] > _MAX_VALUES:
        raise ValueError(f"over {_MAX_VALUES} values")
    return counts[id(value)]


def _check_weights(checkpoint: Checkpoint, size: int) -> None:
    """Raise a ``UserError`` if the weights differ in name, kind or size from the spec's network."""
    with torch.device("meta"):
        network = build_network(checkpoint.spec)
    described = f"stride {checkpoint.stride} and {len(checkpoint.parts)} parts"
    needed = f"stride {network.stride} and {network.num_objects} parts"
    if described != needed:
        raise UserError(described, f"{needed}, as in the spec", _FIX)
    expected, weights = network.state_dict(), checkpoint.state_dict
    odd = sorted(expected.keys() ^ weights.keys()) or [
        name for name, value in expected.items() if not _same_kind(weights[name], value)
    ]
    # A tensor may be a view that repeats few stored numbers; the file must hold all of them.
    stored = 0 if odd else sum(value.numel() * value.element_size() for value in weights.values())
    if odd or stored > size:
        first = odd[0] if odd else "their size"
        problem = f"weights that do not fit the network of the spec, beginning with {first}"
        fix = f"{_FIX}, unchanged"
        raise UserError(problem, f"the {len(expected)} tensors of that network", fix)


def _same_kind(value: object, expected: Tensor) -> bool:
    """Return whether a value is a dense CPU tensor of the expected shape and kind of number."""
    return (
        isinstance(value, Tensor)
        and value.layout is torch.strided
        and value.device.type == "cpu"
        and value.shape == expected.shape
        and value.is_floating_point() == expected.is_floating_point()
        and not value.is_complex()
    )


def _from_numpy(value: object) -> object:
    """Return a numpy scalar or array as built-in types, which load under ``weights_only``."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"a checkpoint holds plain values, got {value!r:.200}")


def released_paths() -> dict[str, Path]:
    """Return the paths of the released checkpoints in the package, by name."""
    folder = Path(__file__).parents[1] / FOLDER
    return {path.stem: path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def find(path: Path) -> Path:
    """Return the file that a path or ``pretrained/NAME``, a released checkpoint, refers to."""
    if path.parent != Path(FOLDER) or path.exists():
        return path
    released = released_paths()
    if path.name not in released:
        names = ", ".join(f"{FOLDER}/{name}" for name in released) or "none"
        problem = f"checkpoint {path}, no such file"
        allowed = f"an existing file, or one of {names}"
        raise UserError(problem, allowed, "use one of these names")
    return released[path.name]


def _read_released(path: Path) -> tuple[dict[str, Any], int]:
    """Return the content of a released file, with float32 weights, and the weights' size, bytes."""
    tensors, metadata = read_safetensors(path)
    if KEY not in metadata:
        problem = f"{path} without a description under {KEY!r}"
        allowed = "a file written by `dopepp release` or `dopepp export`"
        raise UserError(problem, allowed, "download the file again")
    payload = parse_json(metadata[KEY], f"{path}, description under {KEY!r}")
    for name, value in tensors.items():
        tensors[name] = value.float() if value.is_floating_point() else value
    size = sum(value.numel() * value.element_size() for value in tensors.values())
    return {"state_dict": tensors, KEY: payload}, size


def write_content(content: Mapping[str, Any], path: Path, half: bool = True) -> None:
    """Write the result of :meth:`Checkpoint.to_file` as safetensors, in float16 if ``half``.

    Local paths are left out. Weights beyond half precision raise a UserError.
    """
    weights = content["state_dict"]
    if half:
        weights = {name: _half(name, value) for name, value in weights.items()}
    write_safetensors(path, weights, {KEY: payload_json(content[KEY])})


def payload_json(payload: Mapping[str, Any]) -> str:
    """Return the result of :meth:`Checkpoint.to_payload` as a line of JSON, without local paths."""
    return json.dumps(_without_folders(payload), allow_nan=False)


def _half(name: str, value: Tensor) -> Tensor:
    """Convert a floating-point tensor to half precision, and reject values that overflow."""
    if not value.is_floating_point():
        return value
    half = value.to(torch.float16)
    if not half.isfinite().all():
        problem = f"{name} with values up to {float(value.abs().max()):g}"
        allowed = f"finite weights of at most {torch.finfo(torch.float16).max:g}"
        raise UserError(problem, allowed, "train again, because this training has diverged")
    return half


def _without_folders(value: Any, key: str = "") -> Any:
    """Return a description without local paths: file names for files, None for folders."""
    if isinstance(value, Mapping):
        return {name: _without_folders(item, name) for name, item in value.items()}
    if isinstance(value, list):
        return [_without_folders(item, key) for item in value]
    if not isinstance(value, str):
        return value
    if key in _FOLDER_KEYS and ("/" in value or "\\" in value):
        return None
    for kind in (PurePosixPath, PureWindowsPath):
        if kind(value).is_absolute() or value.startswith(("~", "..")):
            return kind(value).name
    return value
