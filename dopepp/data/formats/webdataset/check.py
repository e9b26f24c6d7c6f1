"""Check BOP-WebDataset: tar shards of ``KEY.rgb.jpg``, ``KEY.gt.json`` and so on.

A shard is walked from its first to its last member; one image's members are in memory at a time.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.check_image import ImageRecords, Silhouettes, check_image_records
from dopepp.data.formats.bop.check_models import Models, load_models
from dopepp.data.formats.bop.images import decode_runs
from dopepp.data.formats.bop.writer import STAGING
from dopepp.data.formats.problems import (
    CheckReport,
    decode_json,
    decode_map,
    decode_size,
    load_json,
    mapping,
)
from dopepp.data.formats.webdataset.tar import MAX_MEMBER_BYTES, members

_PICTURE: Final = re.compile(r"(rgb|gray)\.(png|jpe?g|tiff?)")
_DEPTH: Final = re.compile(r"depth\.(png|tiff?)")
_JSON: Final = ("camera", "gt", "gt_info", "mask", "mask_visib")
_KEY_FILE: Final = "key_to_shard.json"
_MAX_IMAGE_BYTES: Final = 2 * MAX_MEMBER_BYTES
"""Of all members of an image together."""

Content = dict[str, bytes]


def shard_paths(root: Path) -> Iterator[Path]:
    """Yield the shards in a folder and in those below it, in order, but no hidden ones."""
    for folder in (root, *sorted(path for path in root.glob("*") if path.is_dir())):
        if folder == root or not folder.name.startswith("."):
            yield from sorted(p for p in folder.glob("*.tar") if not p.name.startswith("."))


def check_webdataset(report: CheckReport) -> None:
    """Check the models and every shard."""
    models = load_models(report, (report.root, *report.root.resolve().parents[:1]))
    seen: dict[Path, dict[str, str]] = {}
    for path in shard_paths(report.root):
        keys = seen.setdefault(path.parent, {})
        for key, content in _images(report, path):
            if key in keys:
                report.add(f"{path}/{key}", "key", f"also in {keys[key]}")
            keys[key] = path.name
            _Image(report, path, key, content, models).check()
            report.count_image()
        staged = len(list((path.parent / STAGING).glob("**/[0-9]*.tar")))
        if staged:
            report.note(f"{path.parent}: {staged} images written and not yet finalized")
    for folder, keys in seen.items():
        _check_key_file(report, folder / _KEY_FILE, keys)


def _check_key_file(report: CheckReport, path: Path, keys: dict[str, str]) -> None:
    """Hold ``key_to_shard.json`` against the shards: ``{key: shard's number}``."""
    if not path.is_file():
        return
    listed = mapping(load_json(report, path))
    if listed:
        for key in sorted(keys.keys() - listed.keys()):
            report.add(path, key, f"missing; it is in {keys[key]}")
        for key in sorted(listed.keys() - keys.keys()):
            report.add(path, key, "in no shard")


def _images(report: CheckReport, path: Path) -> Iterator[tuple[str, Content]]:
    """Yield each key with its members; what is wrong with the archive is a defect."""
    try:
        for _ in members(path):
            pass
    except UserError as error:
        report.add(path, "archive", error.got.removeprefix(f"shard {path}: "))
    key: str | None = None
    content: Content = {}
    done: set[str] = set()
    try:
        for name, extension, data in _files(report, path):
            if name != key:
                if key is not None:
                    yield key, content
                    done.add(key)
                if name in done:
                    report.add(f"{path}/{name}", "key", "its members are not together")
                key, content = name, {}
            if extension in content:
                report.add(f"{path}/{name}.{extension}", "member", "twice")
            content[extension] = data
    except (tarfile.TarError, OSError, EOFError, ValueError, OverflowError):
        pass  # said above: walking the headers fails where reading does
    if key is not None:
        yield key, content


def _files(report: CheckReport, path: Path) -> Iterator[tuple[str, str, bytes]]:
    total: dict[str, int] = {}
    with tarfile.open(path, mode="r:") as archive:
        while (info := archive.next()) is not None:
            archive.members = []  # type: ignore[attr-defined]  # it keeps every header
            name = Path(info.name)
            is_meta = name.name.startswith("__") and name.name.endswith("__")
            if not info.isreg() or is_meta or name.is_absolute() or ".." in name.parts:
                continue
            key, dot, extension = name.name.partition(".")
            key = (name.parent / key).as_posix()
            total = {key: total.get(key, 0) + info.size}
            if not dot or info.issparse() or total[key] > _MAX_IMAGE_BYTES:
                continue  # said by the walk over the headers, but for the size of all together
            file = archive.extractfile(info)
            data = b"" if file is None else file.read(MAX_MEMBER_BYTES)
            if len(data) == info.size:
                yield key, extension.lower(), data


class _Image:
    """The members of one key."""

    def __init__(
        self, report: CheckReport, path: Path, key: str, content: Content, models: Models | None
    ) -> None:
        self._report, self._content, self._models = report, content, models
        self._start = f"{path}/{key}"

    def check(self) -> None:
        report = self._report
        name = next((name for name in self._content if _PICTURE.fullmatch(name)), None)
        size = None
        if name is None:
            report.add(f"{self._start}.rgb.png", "member", "missing")
        else:
            size = decode_size(report, f"{self._start}.{name}", self._content[name])
        depth = next((name for name in self._content if _DEPTH.fullmatch(name)), None)
        if depth is not None:
            path = f"{self._start}.{depth}"
            decode_map(report, path, self._content[depth], size)
        if "camera.json" not in self._content:
            report.add(f"{self._start}.camera.json", "member", "missing")
        parsed = {name: self._json(name) for name in _JSON}
        if "gt.json" not in self._content:
            report.note("some keys have no gt.json: their poses are not published")
        records = ImageRecords(parsed["camera"], parsed["gt"], parsed["gt_info"], depth is not None)
        check_image_records(
            report,
            lambda what: (f"{self._start}.{what}.json", ""),
            records,
            size,
            self._models,
            Silhouettes(
                lambda number: self._mask("mask", parsed["mask"], number, size),
                lambda number: self._mask("mask_visib", parsed["mask_visib"], number, size),
            ),
        )

    def _json(self, name: str) -> Any:
        content = self._content.get(f"{name}.json")
        path = f"{self._start}.{name}.json"
        return None if content is None else decode_json(self._report, path, content)

    def _mask(
        self, name: str, runs: Any, number: int, size: tuple[int, int] | None
    ) -> NDArray[np.bool_] | None:
        if runs is None or size is None:
            return None
        path, where = f"{self._start}.{name}.json", str(number)
        # Objects by number, or (older shards) a list of them.
        by_number = (
            {str(n): record for n, record in enumerate(runs)} if isinstance(runs, list) else runs
        )
        record = mapping(by_number).get(where)
        if record is None:
            self._report.add(path, where, "missing")
            return None
        try:
            return decode_runs(record, (size[1], size[0]), where)
        except UserError as error:
            self._report.add(
                path, where, f"{error.got.removeprefix(f'{where}: ')}; {error.allowed}"
            )
            return None
