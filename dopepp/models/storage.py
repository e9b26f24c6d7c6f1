"""Torch and safetensors files: written atomically, read as untrusted input.

``torch.load(weights_only=True)`` runs no code, but may allocate any memory for a pickle of a few
bytes. Before ``torch.load``, this module therefore compares the archive, the names in the
pickle and the claimed sizes with the bytes of the file.

A safetensors file consists of the length of its header (8 bytes, little endian), the header in
JSON, and numbers. The library compares every tensor with its bytes in the file.
"""

from __future__ import annotations

import io
import os
import pickletools
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, Final

import torch
from safetensors.torch import load, save
from torch import Tensor

from dopepp.core.errors import UserError
from dopepp.core.files import partial_path, read_limited, write_file
from dopepp.core.json import parse_json

MAX_BYTES: Final = 4 * 2**30  # Six times the checkpoint of the full DOPE with Adam's moments
_MAX_PICKLE_BYTES: Final = 16_000_000  # Half a million ADD points; builds at most 80 times as much

_MAX_TUPLES: Final = 50_000
"""Ten for each tensor of any optimiser; a limit, because hashing nested tuples uses the stack."""

_ZIP: Final = b"PK\x03\x04"
_LEGACY: Final = b"\x80\x02"
"""First bytes of a zip archive and, up to torch 1.5, of a pickle of protocol 2."""

_NUM_LEGACY_PICKLES: Final = 5  # Magic number, version, machine, content, storage keys

_STORAGE_BYTES: Final = {
    f"torch {name}Storage": size
    for name, size in {
        "Bool": 1, "Byte": 1, "Char": 1, "Short": 2, "Half": 2, "BFloat16": 2, "Int": 4,
        "Float": 4, "Long": 8, "Double": 8, "ComplexFloat": 8, "ComplexDouble": 16,
    }.items()
}  # fmt: skip
"""Bytes per number of each kind of torch storage."""

_NAMES: Final = {
    *_STORAGE_BYTES,
    "collections OrderedDict",
    "torch Size",
    "torch._utils _rebuild_parameter",
    "torch._utils _rebuild_tensor",
    "torch._utils _rebuild_tensor_v2",
}
"""Names that a pickle may use; each creates an object no larger than its arguments. torch's own
list also has ``bytearray`` and tensor classes, which allocate any size, and
``_rebuild_from_type_v2``, which sets any attribute."""

MAX_SAFETENSORS_BYTES: Final = 2**30  # Five times the full DOPE in float32

MAX_HEADER_BYTES: Final = 16_000_000  # ADD points and meshes of forty parts as text

_MAX_NAME: Final = 200  # Characters of a tensor's name or of a key of the metadata

_LENGTH_BYTES: Final = 8
_METADATA: Final = "__metadata__"
_FIELDS: Final = {"dtype", "shape", "data_offsets"}


def write_atomic(payload: Mapping[str, Any], path: Path, previous: Path | None = None) -> None:
    """Write a torch file atomically, after moving an existing file to ``previous``, if set.

    On an ``OSError`` the old file is intact.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_path(path)
    try:
        with partial.open("wb") as stream:
            try:
                torch.save(dict(payload), stream)
            except RuntimeError as error:
                # torch replaces the original error (no space, Ctrl-C) by an incomplete-file error.
                if isinstance(error.__context__, (OSError, KeyboardInterrupt)):
                    raise error.__context__ from None
                raise
            stream.flush()
            os.fsync(stream.fileno())
        if previous is not None and path.is_file():
            path.replace(previous)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    if os.name == "posix":  # the rename is durable once its folder is; Windows cannot open folders
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def read_mapping(path: Path, kind: str) -> dict[Any, Any]:
    """Load a torch file with a mapping to the CPU, without running code in the file.

    Loading takes no more memory than the file has bytes. ``kind`` describes the file in messages.
    A file that is missing, damaged or too large, or holds other content, raises a UserError.
    """
    path = Path(path)
    _check_file(path, kind)
    try:
        with path.open("rb") as file:
            begin = file.read(len(_LEGACY))
        if begin == _LEGACY:
            _check_legacy(path)
        elif _ZIP.startswith(begin):
            check_container(path, kind)
            _check_archive(path)
        else:
            raise ValueError("neither a zip archive nor a pickle")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except UserError:
        raise
    except Exception as error:  # a damaged or hostile file may raise any exception
        reason = " ".join(str(error).split("\n")[0].split()) or type(error).__name__
        problem = f"{path}, which torch cannot load ({reason[:200]})"
        fix = "download the file again; load only files that you trust"
        raise UserError(problem, kind, fix) from error
    if not isinstance(content, dict):
        fix = "pass a file of this kind"
        raise UserError(f"{path}, which contains a {type(content).__name__}", kind, fix)
    return content


def check_container(path: Path, kind: str) -> int:
    """Return the unpacked size of a torch file, bytes, which must not exceed the file's size."""
    path = Path(path)
    _check_file(path, kind)
    try:
        with path.open("rb") as file:
            # torch would read content before a zip archive.
            if file.read(len(_ZIP)) != _ZIP:
                raise zipfile.BadZipFile("other content before the archive")
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        problem = f"{path}, which is truncated or not a torch file"
        raise UserError(problem, kind, "copy the file again, or write it again") from error
    limit = min(MAX_BYTES, path.stat().st_size)
    if size > limit:
        allowed = f"{kind} of at most {limit} bytes"
        fix = "get the file again from a source that you trust"
        raise UserError(f"{path}, which unpacks to {size} bytes", allowed, fix)
    return size


def _check_file(path: Path, kind: str) -> None:
    if not path.is_file():
        raise UserError(f"{path}, which is not a file", kind, "pass the path of an existing file")


def _check_archive(path: Path) -> None:
    """Raise ``ValueError`` if a zip archive has members that torch would not write."""
    with zipfile.ZipFile(path) as archive:
        # torch may read either of two members with equal names, and either of two pickles.
        sizes = {member.filename.casefold(): member.file_size for member in archive.infolist()}
        if len(sizes) < len(archive.infolist()):
            raise ValueError("two members with equal names")
        pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ValueError(f"{len(pickles)} members FOLDER/data.pkl")
        with archive.open(pickles[0]) as member:
            claimed = _claimed_storages(member.read(_MAX_PICKLE_BYTES + 1))
    folder = pickles[0].removesuffix("data.pkl")
    # Not every version of torch notices a storage that reaches beyond its bytes.
    for key, size in claimed.items():
        stored = sizes.get(f"{folder}data/{key}".casefold())
        if stored != size:
            raise ValueError(f"a storage of {size} bytes, but {stored} bytes in the file")


def _check_legacy(path: Path) -> None:
    """Raise ``ValueError`` if a file of torch before 1.6 claims more numbers than it holds.

    torch allocates a storage before it reads the numbers.
    """
    with path.open("rb") as file:
        claimed = _claimed_storages(file.read(_MAX_PICKLE_BYTES + 1), _NUM_LEGACY_PICKLES)
    if sum(claimed.values()) > path.stat().st_size:
        raise ValueError(
            f"{sum(claimed.values())} bytes of numbers in a file of {path.stat().st_size}"
        )


def _claimed_storages(content: bytes, num_pickles: int = 1) -> dict[str, int]:
    """Return the claimed bytes of each storage, by key, in the first pickles of a file.

    Raise ``ValueError`` if a pickle is damaged, too long, or has operations that weights need not.
    """
    stream, storages = io.BytesIO(content[:_MAX_PICKLE_BYTES]), dict[str, int]()
    try:
        for _ in range(num_pickles):
            for name, key, count in _storage_references(stream):
                claimed = count * _STORAGE_BYTES[name]
                if count < 0 or storages.setdefault(key, claimed) != claimed:
                    raise ValueError(f"storage {key!r:.20} of {count} numbers, or of two sizes")
    except (ValueError, KeyError) as error:
        mb = _MAX_PICKLE_BYTES / 1e6
        long = f", or over {mb:g} MB" if len(content) > _MAX_PICKLE_BYTES else ""
        raise ValueError(f"a pickle with {error!s:.200}{long}") from error
    return storages


class _Name(str):
    """A global name in a pickle, which a plain string cannot imitate."""

    __slots__ = ()


def _storage_references(stream: IO[bytes]) -> Iterator[tuple[str, str, int]]:
    """Yield kind, key and number of values of every storage that a pickle refers to.

    References are tuples of constants. ``top`` is the last constant on the stack, and ``items`` are
    the constants since the last mark; all other objects are None.
    """
    top: Any = None
    items: list[Any] = [None]
    memo: dict[Any, Any] = {}
    num_tuples = 0
    for operation, argument, _ in pickletools.genops(stream):
        name = operation.name
        num_tuples += name.startswith("TUPLE")
        if num_tuples > _MAX_TUPLES:
            raise ValueError(f"over {_MAX_TUPLES} tuples")
        # torch only warns of other protocols; an empty set takes 200 bytes for one byte of pickle.
        if (name == "PROTO" and argument != 2) or name == "EMPTY_SET":
            raise ValueError(f"operation {name} {argument}")
        if name == "GLOBAL" and argument not in _NAMES:
            raise ValueError(f"the name {str(argument).replace(' ', '.')!r:.100}")
        if name == "BINPERSID":
            yield _storage_reference(top)
        if name in ("BINPUT", "LONG_BINPUT"):
            memo[argument] = top
        elif operation.stack_after and not operation.stack_before and name != "MARK":
            constant = _Name(argument) if name == "GLOBAL" else argument
            top = memo[argument] if name in ("BINGET", "LONG_BINGET") else constant
            items.append(top)
        else:
            top = tuple(items) if name == "TUPLE" else None
            items = [] if name == "MARK" else [None]


def _storage_reference(value: object) -> tuple[str, str, int]:
    """Return the kind, key and number of values of a storage reference in a pickle."""
    match value:
        case ("storage", _Name() as kind, str(key), str(), int(count), *_):
            if kind in _STORAGE_BYTES and key.isascii():
                return kind, key, count
    raise ValueError("a reference to an object that is not a storage")


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors (by name, on the CPU) and the metadata of an untrusted safetensors file.

    Raises:
        UserError: The file is missing or damaged, or file or header are too large.
    """
    path = Path(path)
    try:
        content = read_limited(path, MAX_SAFETENSORS_BYTES)
        header = _header(content)
        tensors = load(content)
        # The library has checked the position of every tensor and byte by now.
        entries: Any = parse_json(header, "its header")
        metadata = entries.pop(_METADATA, {})
        # The library accepts unknown fields, and empty or long names.
        complete = all(entry.keys() == _FIELDS for entry in entries.values())
        if not complete or not all(0 < len(name) <= _MAX_NAME for name in (*entries, *metadata)):
            raise ValueError(f"an unknown field, or a name not of 1 to {_MAX_NAME} characters")
    except Exception as error:  # a foreign header may raise any exception
        reason = getattr(error, "strerror", None) or getattr(error, "got", None) or str(error)
        allowed = f"a complete safetensors file of at most {MAX_SAFETENSORS_BYTES >> 20} MiB"
        problem = f"{path}: {' '.join(reason[:300].split())}"
        raise UserError(problem, allowed, "download the file again from its source") from error
    return tensors, metadata


def write_safetensors(
    path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> None:
    """Write tensors and metadata atomically; a ``ValueError`` for a header too long to be read."""
    plain = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    content = save(plain, dict(metadata))
    _header(content)
    write_file(path, content)


def _header(content: bytes) -> bytes:
    """Return the JSON header of a safetensors file, if it has at most ``MAX_HEADER_BYTES``."""
    length = int.from_bytes(content[:_LENGTH_BYTES], "little")
    if length > MAX_HEADER_BYTES:
        raise ValueError(f"a header of {length} bytes, over {MAX_HEADER_BYTES}")
    return content[_LENGTH_BYTES : _LENGTH_BYTES + length]
