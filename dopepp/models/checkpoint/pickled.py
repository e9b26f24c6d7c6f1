"""What a torch file's pickle would do, found out without doing it.

``torch.load(weights_only=True)`` runs no code, but it builds what a pickle of a few bytes asks for:
``bytearray(10**11)`` is on its list of allowed calls, and so is a storage that reaches beyond its
bytes in the file, which not every version of torch notices. So the pickle is followed here first,
with placeholders in place of objects: only what weights and plain values need is let through.
"""

from __future__ import annotations

import io
import pickletools
from collections.abc import Callable
from typing import Any, Final

STORAGE_BYTES: Final = {
    f"torch {name}Storage": size
    for name, size in {
        "Bool": 1, "Byte": 1, "Char": 1, "Short": 2, "Half": 2, "BFloat16": 2, "Int": 4,
        "Float": 4, "Long": 8, "Double": 8, "ComplexFloat": 8, "ComplexDouble": 16,
    }.items()
}  # fmt: skip
"""Bytes of a number in each of torch's kinds of storage."""

CALLS: Final = frozenset(
    {
        "collections OrderedDict",
        "torch Size",
        "torch._utils _rebuild_parameter",
        "torch._utils _rebuild_tensor",
        "torch._utils _rebuild_tensor_v2",
    }
)
"""What a pickle may call: all of them make an object no larger than their arguments."""

MAX_BYTES: Final = 16_000_000
"""Of one pickle: over half a million ADD points. What is built takes at most 80 times as much."""

NUM_LEGACY: Final = 5
"""Pickles before the numbers in a file of torch before 1.6: magic number, version, machine, content
and the storages' keys."""

_CONSTANTS: Final = frozenset(
    {
        *("NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"),
        *("BINUNICODE", "SHORT_BINSTRING"),
    }
)
_EMPTY: Final = frozenset({"EMPTY_LIST", "EMPTY_DICT", "EMPTY_TUPLE"})
_PUT: Final = frozenset({"BINPUT", "LONG_BINPUT"})
_GET: Final = frozenset({"BINGET", "LONG_BINGET"})
_TUPLES: Final = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_DROPPED: Final = {"APPEND": 1, "SETITEM": 2, "BUILD": 1}
"""Operations that put so many objects from the top into the one below them."""

_REFERENCE: Final = 6
"""Entries of a reference to a storage; up to torch 1.5 there was a sixth."""

_THING: Final = None
"""Stands for every object that does not matter."""


class _Global(str):
    """A name that the pickle refers to."""

    __slots__ = ()


class _Reader:
    """Follows a pickle as torch's own reader would.

    Attributes:
        storages: Key of each storage that the pickle refers to, and the bytes it claims.
    """

    def __init__(self) -> None:
        self.storages: dict[str, int] = {}
        self._stack: list[Any] = []
        self._marks: list[list[Any]] = []
        self._memo: dict[int, Any] = {}

    def follow(self, stream: io.BytesIO) -> None:
        """Go through one pickle."""
        for operation, argument, _ in pickletools.genops(stream):
            self._step(operation.name, argument)

    def _step(self, name: str, argument: Any) -> None:
        stack = self._stack
        if name in _CONSTANTS:
            stack.append(argument if isinstance(argument, (str, int)) else _THING)
        elif name in _PUT:
            self._memo[argument] = stack[-1]
        elif name in _GET:
            stack.append(self._memo[argument])
        elif name in _EMPTY:
            stack.append(_THING)
        elif name in _TUPLES:
            del stack[-_TUPLES[name] :]
            stack.append(_THING)
        elif name in _DROPPED:
            del stack[-_DROPPED[name] :]
            _ = stack[-1]  # there is one
        else:
            step: Callable[[Any], None] | None = getattr(self, f"_{name.lower()}", None)
            if step is None:
                raise ValueError(f"operation {name}")
            step(argument)

    def _proto(self, version: int) -> None:
        if version != 2:
            raise ValueError(f"a pickle of protocol {version}")

    def _stop(self, _: object) -> None:
        self._stack.pop()

    def _mark(self, _: object) -> None:
        self._marks.append(self._stack)
        self._stack = []

    def _unmark(self) -> list[Any]:
        items, self._stack = self._stack, self._marks.pop()
        return items

    def _tuple(self, _: object) -> None:
        items = self._unmark()
        # Of tuples, only a reference to a storage matters; others in others could be any size.
        is_reference = len(items) <= _REFERENCE and items[:1] == ["storage"]
        self._stack.append(tuple(items) if is_reference else _THING)

    def _appends(self, _: object) -> None:
        self._unmark()

    _setitems = _appends

    def _global(self, name: str) -> None:
        if name not in CALLS and name not in STORAGE_BYTES:
            raise ValueError(f"the name {name.replace(' ', '.')!r:.100}")
        self._stack.append(_Global(name))

    def _reduce(self, _: object) -> None:
        self._stack.pop()
        called = self._stack.pop()
        if not isinstance(called, _Global) or called not in CALLS:
            raise ValueError("a call of something that may not be called")
        self._stack.append(_THING)

    def _binpersid(self, _: object) -> None:
        match self._stack.pop():
            case ("storage", _Global() as kind, str(key), str(), int(count), *_):
                if kind not in STORAGE_BYTES or count < 0:
                    raise ValueError(f"a storage of {count} numbers in {kind}")
                claimed = count * STORAGE_BYTES[kind]
                if self.storages.setdefault(key, claimed) != claimed:
                    raise ValueError(f"storage {key!r:.20} with two sizes")
            case _:
                raise ValueError("a reference to something that is no storage")
        self._stack.append(_THING)


def claimed_storages(content: bytes, num_pickles: int = 1) -> dict[str, int]:
    """Return the bytes that each storage claims to have, by its key.

    Args:
        content: Pickles one after the other, and whatever follows them.
        num_pickles: How many of them; :data:`NUM_LEGACY` in a file of torch before 1.6.

    Raises:
        ValueError: A pickle is damaged, refers to anything but weights and plain values, or they
            are too long.
    """
    stream = io.BytesIO(content[:MAX_BYTES])
    storages: dict[str, int] = {}
    try:
        for _ in range(num_pickles):
            reader = _Reader()
            reader.follow(stream)
            storages |= reader.storages
    except (ValueError, IndexError, KeyError, TypeError, AttributeError) as error:
        long = f", or over {MAX_BYTES / 1e6:g} MB" if len(content) > MAX_BYTES else ""
        raise ValueError(f"a pickle with {error!s:.200}{long}") from error
    return storages
