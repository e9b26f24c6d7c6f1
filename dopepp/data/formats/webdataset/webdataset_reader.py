"""Read BOP-WebDataset: tar shards with random access, so a run resumes exactly."""

from __future__ import annotations

import hashlib
import logging
import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache, cached_property, partial
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any, Final
from urllib.parse import urlsplit

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.files import draft
from dopepp.core.json import MAX_BYTES
from dopepp.data.formats import ESTIMATED, bop, make_instance, share_slice
from dopepp.data.formats.bop.bop_models import parts_by_id
from dopepp.data.formats.images import decode_depth, decode_rgb, decode_runs
from dopepp.data.formats.problems import STRICT, Node, Problems, mapping
from dopepp.data.formats.webdataset import FIELDS, ShardIndex, index_shard
from dopepp.data.sample import Sample, SourceInfo
from dopepp.drawing.pictures import Mask, Shape
from dopepp.geometry.camera import check_camera
from dopepp.parts.part import Part

_log = logging.getLogger(__name__)

MAX_SHARDS: Final = 100_000
MAX_SHARD_BYTES: Final = 20_000_000_000  # largest shard to download; BOP's have about 1 GB
_MAX_TEXT: Final = 4000  # characters of a name

_MAX_BRACES: Final = 10
_PIECE_BYTES: Final = 1 << 20

_RANGE: Final = re.compile(r"\{(-?\d+)\.\.(-?\d+)(?:\.\.-?\d+)?\}")
_SCHEME: Final = re.compile(r"([a-z][a-z0-9+.-]+):", re.IGNORECASE)


class WebdatasetReader:
    """Reader of the images of shards, in the order of the shards.

    The constructor reads headers; members are read and checked with their image. An image
    without ``gt.json`` has no instances. Objects that are not among the parts or lie behind the
    camera are ignored. The visible fraction is ``visib_fract`` of ``gt_info.json``, or an estimate
    of :func:`~dopepp.data.formats.make_instance`.

    Args:
        parts: Objects to return, named as in ``models_info.json`` or ``obj_000001``.
        shards: A folder in ``root``, a file or a URL; see :func:`find_shards`.
        download_dir: Folder for shards from URLs; None rejects URLs.
    """

    def __init__(
        self,
        root: str | Path,
        parts: Sequence[Part],
        shards: str = ".",
        part_of: tuple[float, float] = (0.0, 1.0),
        read_depth: bool = True,
        download_dir: str | Path | None = None,
    ) -> None:
        self.root = Path(root)
        self.name = f"webdataset/{shards}"
        self._parts = parts_by_id(self.root, parts)
        self._read_depth, self._logged_inexact = read_depth, False
        folder = None if download_dir is None else Path(download_dir)
        self._shards = [index_shard(path) for path in find_shards(self.root, shards, folder)]
        _check_keys(self._shards)
        items = [(shard, row) for shard in self._shards for row in range(len(shard.keys))]
        self._items = items[share_slice(len(items), part_of, self.name)]

    def __len__(self) -> int:
        return len(self._items)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Read an image; the epoch is ignored."""
        shard, row = self._items[index]
        records = _records(shard, row)
        content = shard.read(row, "image")
        assert content is not None  # index_shard requires an image for every key
        image = decode_rgb(content, records.start)
        shape: Shape = image.shape[:2]
        K, scales = bop.read_cameras([records.json("camera")], records.nodes)
        camera = check_camera(K[0], (shape[1], shape[0]), records.start)
        has_masks = records.json("mask_visib") is not None
        poses = records.poses()
        if poses.inexact.any() and not self._logged_inexact:
            self._logged_inexact = True
            problem = f"rotations orthogonal to {bop.INEXACT:g} only"
            _log.warning("%s: %s; using the nearest rotations", records.start, problem)
        instances = []
        for k in self._select_objects(poses):
            mask = records.mask("mask_visib", k, shape) if has_masks else None
            part = self._parts[int(poses.obj_ids[k])]
            T, fraction = poses.T_cam_obj[k], float(poses.visible_fractions[k])
            instances.append(make_instance(part, T, camera, fraction, mask, shape))
        encoded, depth = shard.read(row, "depth") if self._read_depth else None, None
        if encoded is not None:
            depth = decode_depth(encoded, f"{records.start}.depth", float(scales[0]), shape)
        return Sample(image, camera, instances, depth, self.name, shard.keys[row])

    def _select_objects(self, poses: bop.BopPoses) -> list[int]:
        """Return the indices of objects that are among the parts and in front of the camera."""
        is_selected = np.isin(poses.obj_ids, list(self._parts)) & (poses.T_cam_obj[:, 2, 3] > 0)
        return [int(number) for number in np.flatnonzero(is_selected)]

    def contains(self, label: str) -> bool:
        """Return whether the object is annotated on any image; read annotations until it is."""
        object_ids = {number for number, part in self._parts.items() if part.name == label}
        for shard, row in self._items if object_ids else ():
            poses = _records(shard, row).poses()
            if any(int(poses.obj_ids[k]) in object_ids for k in self._select_objects(poses)):
                return True
        return False

    def files(self) -> list[Path]:
        """Return the shards."""
        return [shard.path for shard in self._shards]

    def describe(self) -> list[SourceInfo]:
        """Return one entry: hashes of members and meshes, and the source of visible fractions."""
        digest, has_infos = hashlib.sha256(), True
        for shard, row in self._items:
            digest.update(shard.keys[row].encode())
            digest.update(shard.spans[row, :, 1].tobytes())
            has_infos &= bool(shard.spans[row, [*FIELDS].index("gt_info"), 0] >= 0)
        identity: dict[str, object] = {
            "shards": [shard.path.name for shard in self._shards],
            "members": digest.hexdigest(),
            "objects": {part.name: part.mesh_hash for part in self._parts.values()},
            "visible_fractions": "gt_info.json" if has_infos else ESTIMATED,
        }
        return [SourceInfo(self.name, len(self), identity)]


class ShardRecords:
    """The JSON members of one image, each parsed on first use.

    Args:
        start: Start of the members' paths, ``SHARD/KEY``.
        read: Returns a member's content by its name, e.g. ``gt``; None if missing.
        problems: Receiver of problems.
    """

    def __init__(
        self, start: str, read: Callable[[str], bytes | None], problems: Problems = STRICT
    ) -> None:
        self.start, self._read, self._problems = start, read, problems
        self.json = cache(self._json)

    def _member(self, name: str) -> Node:
        return Node(self._problems, f"{self.start}.{name}.json")

    def nodes(self, record_kind: str, number: int) -> Node:
        """Return the node of a ``camera``, ``gt`` or ``gt_info`` record, for error messages."""
        member = self._member(record_kind)
        return member if record_kind == "camera" else member[number]

    def _json(self, name: str) -> Any:
        """Return a JSON member's content; None if it is missing, too large or no JSON."""
        content, member = self._read(name), self._member(name)
        if content is None or len(content) <= MAX_BYTES:
            return None if content is None else member.decode(content)
        allowed = f"at most {MAX_BYTES / 1e6:.0f} MB"
        member["member"].report(f"{len(content) / 1e6:.0f} MB", allowed)
        return None

    @cached_property
    def truths(self) -> list[bop.Record]:
        """The ``gt`` records of the objects."""
        content = self.json("gt")
        return [] if content is None else self._member("gt").entries(content)

    @cached_property
    def infos(self) -> list[bop.Record | None]:
        """The ``gt_info`` record of each object; None if missing."""
        return bop.pair_infos(self.truths, self.json("gt_info"), self._member("gt_info"))

    def poses(self) -> bop.BopPoses:
        """Return the poses of the image's objects; empty without ``gt.json``."""
        return bop.read_poses(self.truths, self.infos, self.nodes)

    def mask(self, name: str, number: int, shape: Shape) -> Mask | None:
        """Return the mask of object ``number`` from ``mask`` or ``mask_visib``; None if damaged."""
        runs = self.json(name)
        # A mapping by number or, in older shards, a list.
        listed = dict(enumerate(runs)) if isinstance(runs, list) else {}
        record = listed.get(number, mapping(runs).get(f"{number}"))
        return decode_runs(record, shape, self._member(name)[f"{number}"])


def _records(shard: ShardIndex, image: int) -> ShardRecords:
    return ShardRecords(f"{shard.path}/{shard.keys[image]}", partial(shard.read, image))


def _check_keys(shards: Sequence[ShardIndex]) -> None:
    shard_of: dict[str, Path] = {}
    for shard in shards:
        if repeated := [key for key in shard.keys if key in shard_of]:
            problem = f"{shard.path}, which repeats {len(repeated)} keys of {shard_of[repeated[0]]}"
            fix = "delete the repeated shard, or write it again"
            allowed = "each key in only one shard"
            raise UserError(f"{problem}, e.g. {', '.join(repeated[:3])}", allowed, fix)
        shard_of |= dict.fromkeys(shard.keys, shard.path)


def find_shards(root: Path, shards: str, download_dir: Path | None = None) -> list[Path]:
    """Return the shards as local files, in order.

    Args:
        root: Folder of the data set.
        shards: A folder in ``root`` (its ``*.tar`` by name), a file or a URL; braces as in
            ``shard-{000000..000009}.tar`` are expanded.
        download_dir: Folder that keeps shards from URLs; None rejects URLs.

    Raises:
        UserError: A shard is missing or listed twice, a brace is wrong, or a download fails.
    """
    paths = []
    for text in _expand_braces(shards):
        scheme = _SCHEME.match(text)
        if scheme is None:
            paths += _local_shards(root / text)
        else:
            paths.append(_fetch_shard(text, scheme[1].lower(), download_dir))
    if len(set(paths)) < len(paths):
        twice, _ = Counter(paths).most_common(1)[0]
        fix = "name every shard once in data.image_sets"
        raise UserError(f"shard {twice} twice", "each shard once", fix)
    return paths


def _expand_braces(text: str) -> list[str]:
    from braceexpand import braceexpand  # comes with the webdataset library

    # The library builds a whole range at once and does not limit the product of braces.
    lengths = [abs(int(m[2]) - int(m[1])) for m in _RANGE.finditer(text[:_MAX_TEXT])]
    if max(len(text) - _MAX_TEXT, text.count("{") - _MAX_BRACES) <= 0:
        try:
            if max(lengths, default=0) < MAX_SHARDS:
                expanded = list(islice(braceexpand(text), MAX_SHARDS + 1))
                if len(expanded) <= MAX_SHARDS:
                    return expanded
        except ValueError as error:
            problem, allowed = f"shards {text!r:.100}: {error}", "braces as in shard-{00..09}.tar"
            raise UserError(problem, allowed, "write the braces in this form") from error
    fix = "shorten the range of numbers, or name a folder of shards"
    raise UserError(f"shards {text!r:.100}", f"at most {MAX_SHARDS:,} shards", fix)


def _local_shards(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    shards = sorted(file for file in path.glob("*.tar") if not file.name.startswith("."))
    if shards:
        return shards
    problem = "a folder without *.tar" if path.is_dir() else "no such file or folder"
    allowed = "a folder of shards (*.tar), a single shard, or a URL"
    fix = "set data.root and data.image_sets to existing shards"
    raise UserError(f"shards {path}, {problem}", allowed, fix)


def _fetch_shard(url: str, scheme: str, folder: Path | None) -> Path:
    """Return the path of a shard in a folder, where the webdataset library downloads it once."""
    if folder is None:
        problem = f"shards {url!r:.100}, which are not on this machine"
        allowed = "local shards, or a folder to download them into"
        raise UserError(problem, allowed, "set data.download_dir=FOLDER")
    # Shards of different data sets often have one name, e.g. shard-000000.tar.
    stem = PurePosixPath(urlsplit(url).path).name.removesuffix(".tar")[:100]
    path = folder / f"{stem}-{hashlib.sha256(url.encode()).hexdigest()[:12]}.tar"
    if path.exists():
        return path
    from webdataset.gopen import gopen, gopen_schemes  # imports torch where it is installed

    # "pipe" is a command to run, which an untrusted config must not do.
    schemes = sorted(gopen_schemes.keys() - {"__default__", "pipe"})
    if scheme not in schemes:
        fix = "download the shards and pass their folder"
        raise UserError(f"shards {url!r:.100}", f"URLs of {', '.join(schemes)}", fix)
    _log.info("downloading %s to %s", url, path)
    size = 0
    try:
        with draft(path) as partial, gopen(url) as stream, partial.open("wb") as file:
            while piece := stream.read(_PIECE_BYTES):
                size += file.write(piece)
                if size > MAX_SHARD_BYTES:
                    allowed = f"shards of at most {MAX_SHARD_BYTES / 1e9:.0f} GB"
                    problem = f"{url} of over {size / 1e9:.0f} GB"
                    raise UserError(problem, allowed, "divide this shard into smaller ones")
    except OSError as error:
        problem = f"shard {url}, which cannot be downloaded to {path.parent}: {error!s:.200}"
        allowed = "a readable URL and enough disk space"
        fix = "open the URL in a browser to test it, and free space"
        raise UserError(problem, allowed, fix) from error
    return path
