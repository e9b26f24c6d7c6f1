"""Check BOP-WebDataset: tar shards of ``KEY.rgb.jpg``, ``KEY.gt.json`` and so on.

A shard is walked from its first to its last member; one image's members are in memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from dopepp.data.formats import STAGING
from dopepp.data.formats.bop.check_image import (
    Mask,
    Models,
    Silhouettes,
    check_image,
    load_models,
)
from dopepp.data.formats.bop.images import DEPTH_MODES, decode_runs, one_channel_of
from dopepp.data.formats.bop.records import pair_infos
from dopepp.data.formats.problems import (
    CheckReport,
    attempt,
    decode_json,
    entries,
    load_object,
    mapping,
    picture_shape,
)
from dopepp.data.formats.webdataset.tar import (
    KEY_FILE,
    MAX_MEMBER_BYTES,
    TarMember,
    field_of,
    members,
    read_span,
)

_MAX_IMAGE_BYTES: Final = 2 * MAX_MEMBER_BYTES
"""Of all members of an image together."""

Content = dict[str, bytes]
"""An image's members by extension."""


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
        for key, group in groupby(members(path, report), key=lambda member: member.key):
            if key in keys:
                same = keys[key] == path.name
                got = "its members are not together" if same else f"also in {keys[key]}"
                report.report(f"{path}/{key}", "key", got)
            keys[key] = path.name
            _Image(report, f"{path}/{key}", _content(report, path, group), models).check()
            report.count_image()
        staged = len(list((path.parent / STAGING).glob("**/[0-9]*.tar")))
        if staged:
            report.note(f"{path.parent}: {staged} images written and not yet finalized")
    for folder, keys in seen.items():
        _check_key_file(report, folder / KEY_FILE, keys)


def _check_key_file(report: CheckReport, path: Path, keys: dict[str, str]) -> None:
    """Hold ``key_to_shard.json`` against the shards: ``{key: shard's number}``."""
    listed = load_object(report, path) if path.is_file() else None
    if listed:
        for key in sorted(keys.keys() - listed.keys()):
            report.report(path, key, f"missing; it is in {keys[key]}")
        for key in sorted(listed.keys() - keys.keys()):
            report.report(path, key, "in no shard")


def _content(report: CheckReport, path: Path, group: Iterator[TarMember]) -> Content:
    """Read an image's members, as many as may be in memory."""
    content: Content = {}
    total = 0
    for _, extension, *span in group:
        total += span[1]
        if total <= _MAX_IMAGE_BYTES:
            data = attempt(report, path, "archive", partial(read_span, path, *span))
            content |= {} if data is None else {extension: data}
    return content


class _Image:
    """The members of one key."""

    def __init__(
        self, report: CheckReport, start: str, content: Content, models: Models | None
    ) -> None:
        self._report, self._start, self._content, self._models = report, start, content, models

    def check(self) -> None:
        report, shape = self._report, None
        name = self._name_of("image")
        if name is None:
            report.report(f"{self._start}.rgb.png", "member", "missing")
        else:
            shape = picture_shape(report, f"{self._start}.{name}", self._content[name])
        depth = self._name_of("depth")
        if depth is not None:
            path = f"{self._start}.{depth}"
            one_channel_of(report, path, shape, self._content[depth], DEPTH_MODES)
        if "camera.json" not in self._content:
            report.report(f"{self._start}.camera.json", "member", "missing")
        if "gt.json" not in self._content:
            report.note("some keys have no gt.json: their poses are not published")
        truths, infos = self._entries("gt"), self._entries("gt_info")
        path = f"{self._start}.gt_info.json"
        check_image(
            report,
            lambda what, n: (f"{self._start}.{what}.json", "" if what == "camera" else f"[{n}]"),
            self._json("camera"),
            truths,
            pair_infos(truths, infos, path, "", report)
            if "gt_info.json" in self._content
            else [None] * len(truths),
            shape,
            depth is not None,
            self._models,
            Silhouettes(self._masks("mask", shape), self._masks("mask_visib", shape)),
        )

    def _name_of(self, field: str) -> str | None:
        return next((name for name in self._content if field_of(name) == field), None)

    def _json(self, name: str) -> Any:
        content = self._content.get(f"{name}.json")
        path = f"{self._start}.{name}.json"
        return None if content is None else decode_json(self._report, path, content)

    def _entries(self, name: str) -> list[Any]:
        records = self._json(name)
        path = f"{self._start}.{name}.json"
        return [] if records is None else entries(self._report, path, "", records)

    def _masks(self, name: str, shape: tuple[int, int] | None) -> Any:
        """Return a function that reads an object's mask by its number."""
        runs, path = self._json(name), f"{self._start}.{name}.json"
        # Objects by number, or (older shards) a list of them.
        by_number = (
            {str(n): record for n, record in enumerate(runs)} if isinstance(runs, list) else runs
        )

        def read(number: int) -> Mask | None:
            if runs is None or shape is None:
                return None
            record = mapping(by_number).get(f"{number}")
            if record is None:
                self._report.report(path, f"{number}", "missing")
                return None
            return decode_runs(record, shape, path, f"{number}", self._report)

        return read
