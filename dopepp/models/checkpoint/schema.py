"""The checkpoint's schema: one self-describing file, read under ``weights_only=True``.

A file is a Lightning checkpoint (or just these two keys): the weights under ``state_dict``,
prefixed ``network.``, and under ``dopepp`` everything that turns them into a pose estimator. This
module alone knows the file; training writes it, inference and experiment read it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import torch
from torch import Tensor

from dopepp.core.errors import UserError
from dopepp.models.checkpoint import released
from dopepp.models.checkpoint.storage import check_container, read_mapping, write_atomic
from dopepp.models.network import PoseNetwork
from dopepp.models.spec import architecture, build_network
from dopepp.parts.part import Part
from dopepp.parts.seen import Seen

__all__ = ["Checkpoint", "load_network", "parse_description", "read", "write_atomic"]

KEY: Final = released.KEY
STATE_PREFIX: Final = "network."
FORMAT_VERSION: Final = 2
"""2 since parts have a mesh; files of version 1 are read as well."""

MAX_SIDE: Final = 8192
"""Pixels of an input: an image is enlarged to it, so it decides about memory."""

_MAX_VALUES: Final = 4_000_000
_MAX_DEPTH: Final = 32
_MAX_BITS: Final = 128
"""Values, levels of nesting, bits of a whole number: more than any file of ours has."""

_WHAT: Final = "a checkpoint (.ckpt) written by train.py"

T = TypeVar("T")


@dataclass(eq=False)
class Checkpoint:
    """A trained network and all that is needed to use it.

    Attributes:
        spec: The network's spec (:mod:`dopepp.models.spec`), without pretrained weights' path.
        state_dict: The network's weights, without prefix.
        parts: The objects, in channel order.
        input_size: (width, height) the network was trained at, pixels.
        stride: Pixels per map cell.
        sigma: Standard deviation of the belief targets, cells.
        recovery: Thresholds that turn maps into detections.
        data: The data and camera configuration it was trained on.
        data_fingerprint: Hash that changes whenever the training data would.
        metrics: Validation figures at the time of writing.
        seen: How large and how far away the network has seen its parts, by name; none where an
            earlier version has written it.
        format_version: Version of this schema.
    """

    spec: dict[str, Any]
    state_dict: dict[str, Tensor]
    parts: list[Part]
    input_size: tuple[int, int]
    stride: int
    sigma: float
    recovery: dict[str, float] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)
    data_fingerprint: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    seen: dict[str, Seen] = field(default_factory=dict)
    format_version: int = FORMAT_VERSION

    def to_payload(self) -> dict[str, Any]:
        """Return everything but the weights as plain values, for the file's ``dopepp`` key.

        Raises:
            TypeError: A value is neither plain nor a numpy scalar or array.
        """
        payload: dict[str, Any] = _plain(
            {
                "format_version": self.format_version,
                "spec": architecture(self.spec),
                "parts": [part.to_record() for part in self.parts],
                "input_size": list(self.input_size),
                "stride": self.stride,
                "sigma": self.sigma,
                "recovery": self.recovery,
                "data": self.data,
                "data_fingerprint": self.data_fingerprint,
                "metrics": self.metrics,
                "seen": self.seen,
            }
        )
        return payload

    def to_file(self) -> dict[str, Any]:
        """Return the content of a file that holds this checkpoint and no training state."""
        weights = {STATE_PREFIX + name: value for name, value in self.state_dict.items()}
        return {"state_dict": weights, KEY: self.to_payload()}


def read(path: Path) -> Checkpoint:
    """Read a checkpoint and check that its weights fit its own spec.

    The path is of a file that training or ``dopepp release`` has written, or ``pretrained/NAME``. A
    :class:`UserError`: the file is missing, damaged, foreign, too large, written by a newer
    version, names something that may not be built, or is not consistent.
    """
    path = released.find(Path(path))
    if path.suffix == released.SUFFIX:
        content, size = released.read_content(path)
    else:
        size = check_container(path, _WHAT)
        content = read_mapping(path, _WHAT)
    if KEY not in content:
        raise UserError(f"{path} without {KEY!r} entry", _WHAT, "pass a file written by train.py")
    try:
        checkpoint = _parse(content)
        _check_weights(checkpoint, size)
    except UserError as error:
        raise UserError(f"{error.got}, in checkpoint {path}", error.allowed, error.fix) from error
    return checkpoint


def load_network(path: Path) -> tuple[PoseNetwork, Checkpoint]:
    """Read a checkpoint as :func:`read`; return its network, evaluating on the CPU, and itself."""
    checkpoint = read(path)
    network = build_network(checkpoint.spec)
    network.load_state_dict(checkpoint.state_dict)
    return network.eval(), checkpoint


def _parse(content: Mapping[str, Any]) -> Checkpoint:
    weights = _parse_weights(content.get("state_dict"))
    return replace(parse_description(content[KEY]), state_dict=weights)


def parse_description(payload: object) -> Checkpoint:
    """Read what :meth:`Checkpoint.to_payload` returns back, as a checkpoint without weights.

    A :class:`UserError` says which field of it is not as it should be. Nothing is built.
    """
    if not isinstance(payload, dict):
        raise UserError(f"a {type(payload).__name__} under {KEY!r}", "a mapping", "train again")
    _check_plain(payload)
    version = _take(payload, "format_version", int)
    if not 1 <= version <= FORMAT_VERSION:
        fix = "update dopepp to read this file"
        raise UserError(f"format_version {version}", f"1 to {FORMAT_VERSION}", fix)
    input_size = _take(payload, "input_size", list)
    sound = all(type(side) is int and 0 < side <= MAX_SIDE for side in input_size)
    if len(input_size) != 2 or not sound:
        allowed = f"[width, height] in pixels, at most {MAX_SIDE}"
        raise UserError(f"input_size {input_size!r:.100}", allowed, "train again")
    sigma = _take(payload, "sigma", float)
    if not (math.isfinite(sigma) and sigma > 0):
        raise UserError(f"sigma {sigma}", "a positive number of cells", "train again")
    return Checkpoint(
        spec=architecture(_take(payload, "spec", dict)),
        state_dict={},
        parts=[Part.from_record(record) for record in _take(payload, "parts", list)],
        input_size=(input_size[0], input_size[1]),
        stride=_take(payload, "stride", int),
        sigma=sigma,
        recovery=_take_numbers(payload, "recovery"),
        data=_take(payload, "data", dict),
        data_fingerprint=_take(payload, "data_fingerprint", str),
        metrics=_take_numbers(payload, "metrics"),
        seen=_parse_seen(payload.get("seen", {})),
        format_version=version,
    )


def _check_plain(payload: Mapping[Any, Any]) -> None:
    """Refuse what is not plain, nested too deep, or too much.

    A list that holds one other list many times, and so on, takes no memory until somebody prints or
    walks it.
    """
    known: dict[int, int] = {}
    for name, value in payload.items():
        try:
            _count(value, 0, known)
        except ValueError as error:
            allowed = "mappings, lists, text, numbers, true/false and null"
            fix = "write the file with train.py"
            raise UserError(f"{name!s:.50} with {error}", allowed, fix) from error


def _count(value: object, depth: int, known: dict[int, int]) -> int:
    """Return how many plain values there are in one, as often as they are there.

    ``known`` are the numbers of containers that were counted, by their identity.
    """
    if type(value) not in (dict, list, tuple):
        if isinstance(value, int) and value.bit_length() > _MAX_BITS:
            raise ValueError(f"a whole number of {value.bit_length()} bits")
        if type(value) not in (str, int, float, bool, type(None)):
            raise ValueError(f"a {type(value).__name__}")
        return 1
    if id(value) not in known:
        if depth == _MAX_DEPTH:
            raise ValueError(f"values nested more than {_MAX_DEPTH} deep")
        items: Iterable[object] = value  # type: ignore[assignment]
        if isinstance(value, dict):
            odd = next((key for key in value if type(key) not in (str, int)), None)
            if odd is not None:
                raise ValueError(f"a key of type {type(odd).__name__}")
            items = value.values()
        known[id(value)] = 1 + sum(_count(item, depth + 1, known) for item in items)
    if known[id(value)] > _MAX_VALUES:
        raise ValueError(f"over {_MAX_VALUES} values")
    return known[id(value)]


def _take(payload: Mapping[str, Any], name: str, expected: type[T]) -> T:
    value = payload.get(name)
    if type(value) is not expected:
        allowed = f"{name} as {expected.__name__}"
        raise UserError(f"{name} {value!r:.100}", allowed, "write the file with train.py")
    return value


def _take_numbers(payload: Mapping[str, Any], name: str) -> dict[str, float]:
    numbers = _take(payload, name, dict)
    for key, value in numbers.items():
        if type(key) is not str or type(value) not in (int, float):
            got = f"{name} with {key!r:.100}: {value!r:.100}"
            raise UserError(got, "numbers by name", "train again")
    return numbers


def _parse_seen(ranges: object) -> dict[str, Seen]:
    if not isinstance(ranges, dict):
        raise UserError(f"seen {ranges!r:.100}", "four numbers by name", "train again")
    return {str(name): Seen.parse(values) for name, values in ranges.items()}


def _parse_weights(state_dict: object) -> dict[str, Tensor]:
    if not isinstance(state_dict, dict):
        got = f"state_dict as {type(state_dict).__name__}"
        raise UserError(got, "weights by name", "write it with train.py")
    return {
        name.removeprefix(STATE_PREFIX): value
        for name, value in state_dict.items()
        if isinstance(name, str) and name.startswith(STATE_PREFIX)
    }


def _check_weights(checkpoint: Checkpoint, size: int) -> None:
    """Compare the weights with the network of the spec, built without memory on ``meta``."""
    with torch.device("meta"):
        network = build_network(checkpoint.spec)
    if checkpoint.stride != network.stride or network.num_objects != len(checkpoint.parts):
        raise UserError(
            f"stride {checkpoint.stride} and {len(checkpoint.parts)} parts",
            f"stride {network.stride} and {network.num_objects} parts, as the spec has it",
            "write the file with train.py",
        )
    expected, weights = network.state_dict(), checkpoint.state_dict
    odd = sorted(expected.keys() ^ weights.keys()) or [
        name for name, value in expected.items() if not _same_kind(weights[name], value)
    ]
    # A tensor may be a view that repeats a few stored numbers to any size: the file must hold all.
    stored = 0 if odd else sum(value.numel() * value.element_size() for value in weights.values())
    if odd or stored > size:
        raise UserError(
            f"weights that do not fit the spec's network, first {odd[0] if odd else 'their size'}",
            f"the {len(expected)} tensors of that network",
            "write the file with train.py, or use the spec it was trained with",
        )


def _same_kind(value: object, expected: Tensor) -> bool:
    return (
        isinstance(value, Tensor)
        and value.layout is torch.strided
        and value.device.type == "cpu"
        and value.shape == expected.shape
        and value.is_floating_point() == expected.is_floating_point()
        and not value.is_complex()
    )


def _plain(value: Any) -> Any:
    """Return a value as exact built-in types; a numpy scalar would not load with weights_only."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    if value is None:
        return None
    raise TypeError(f"a checkpoint holds plain values, got {value!r:.200}")
