"""Check BOP-WebDataset: tar files with members ``KEY.rgb.jpg``, ``KEY.gt.json`` etc.

A check reads a shard from start to end, with the members of one image in memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Final

from dopepp.data.formats import STAGING
from dopepp.data.formats import webdataset as shards
from dopepp.data.formats.bop import BopPoses
from dopepp.data.formats.bop.bop_invariants import Deviations, ModelSizes, check_image, load_models
from dopepp.data.formats.images import COLOUR_MODES, DEPTH_MODES, decode_one_channel, image_shape
from dopepp.data.formats.problems import CheckReport, Node
from dopepp.data.formats.webdataset.webdataset_reader import ShardRecords
from dopepp.drawing.pictures import Mask, Shape

_MAX_IMAGE_BYTES: Final = 2 * shards.MAX_MEMBER_BYTES
"""Limit of the sum of the sizes of an image's members."""

Content = dict[str, bytes]  # an image's members by extension


def shard_paths(root: Path) -> Iterator[Path]:
    """Yield the visible shards in a folder and its subfolders, in order."""
    for folder in (root, *sorted(path for path in root.glob("*") if path.is_dir())):
        if folder == root or not folder.name.startswith("."):
            yield from sorted(p for p in folder.glob("*.tar") if not p.name.startswith("."))


def check_webdataset(report: CheckReport) -> None:
    """Check the models, every shard and ``key_to_shard.json``."""
    models = load_models(report, (report.root, *report.root.resolve().parents[:1]))
    shard_names: dict[Path, dict[str, str]] = {}  # by folder and key
    for path in shard_paths(report.root):
        keys, deviations = shard_names.setdefault(path.parent, {}), Deviations()
        for key, group in groupby(shards.members(path, report), key=lambda member: member.key):
            if key in keys:
                is_same = keys[key] == path.name
                problem = "its members are not together" if is_same else f"also in {keys[key]}"
                report.report(f"{path}/{key}", "key", problem)
            keys[key] = path.name
            content = _content(report, path, group)
            deviations.count(_check_image(report, f"{path}/{key}", content, models), models)
            report.count_image()
        deviations.note(report, path)
        if staged := len(list((path.parent / STAGING).glob("**/[0-9]*.tar"))):
            report.note(f"{path.parent}: {staged} images written and not yet finalized")
    for folder, keys in shard_names.items():
        node = Node(report, folder / shards.KEY_FILE)
        listed = node.load() if (folder / shards.KEY_FILE).is_file() else None
        if listed:
            for key in sorted(keys.keys() - listed.keys()):
                node[key].report(f"missing; it is in {keys[key]}")
            for key in sorted(listed.keys() - keys.keys()):
                node[key].report("in no shard")


def _content(report: CheckReport, path: Path, group: Iterator[shards.TarMember]) -> Content:
    """Read the members of an image; skip members beyond the size limit of an image."""
    content: Content = {}
    total = 0
    for _, extension, *span in group:
        total += span[1]
        if total <= _MAX_IMAGE_BYTES:
            data = Node(report, path, "archive").attempt(partial(shards.read_span, path, *span))
            content |= {} if data is None else {extension: data}
    return content


def _check_image(
    report: CheckReport, start: str, content: Content, models: ModelSizes | None
) -> BopPoses:
    """Check the members of one image, whose paths begin with ``start``; return its poses."""
    names = {shards.field_of(name): name for name in reversed(content)}
    shape: Shape | None = None
    if name := names.get("image"):
        shape = image_shape(Node(report, f"{start}.{name}"), content[name], COLOUR_MODES)
    else:
        report.report(f"{start}.rgb.png", "member", "missing")
    if name := names.get("depth"):
        decode_one_channel(Node(report, f"{start}.{name}"), shape, content[name], DEPTH_MODES)
    if "camera.json" not in content:
        report.report(f"{start}.camera.json", "member", "missing")
    if "gt.json" not in content:
        report.note("some keys have no gt.json: their poses are not published")
    records = ShardRecords(start, lambda name: content.get(f"{name}.json"), report)

    camera, truths, infos = records.json("camera"), records.truths, records.infos
    present = {name for name in ("mask", "mask_visib") if records.json(name) is not None}

    def read_mask(name: str, number: int) -> Mask | None:
        return records.mask(name, number, shape) if shape and name in present else None

    has_depth = "depth" in names
    return check_image(records.nodes, camera, truths, infos, shape, has_depth, models, read_mask)
