"""Write BOP-WebDataset shards: stage items, and finalize shard by shard.

``train_pbr/shard-000012.tar`` holds images 12,000 – 12,999 in order. Until the shard is finalized,
each image is a small archive in the hidden folder ``.items``.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Final

from dopepp.core.files import encode_image, partial_path, write_file
from dopepp.data.formats import STAGING, encode_by_key, read_object, stage_item
from dopepp.data.formats.bop.bop_writer import BopFolder
from dopepp.data.formats.images import encode_runs
from dopepp.data.formats.webdataset import KEY_FILE, TarMember, members, read_span
from dopepp.data.sample import Sample

_OWNER: Final = "dopepp"  # fixed, with a modification time of 0: equal images have equal bytes
Content = dict[str, bytes]  # an image's members by extension


class WebdatasetWriter(BopFolder):
    """A :class:`~dopepp.data.formats.Writer` of BOP-WebDataset shards."""

    name, suffix = "webdataset", ".tar"

    def write(self, index: int, sample: Sample) -> None:
        """Write an image's archive to the staging folder."""
        labels = self.labels(sample)
        content = {
            "rgb.png": encode_image(sample.image),
            "depth.png": encode_image(labels.depth),
            "camera.json": json.dumps(labels.camera).encode(),
            "gt.json": json.dumps(labels.truths).encode(),
            "gt_info.json": json.dumps(labels.infos).encode(),
        }
        for name, masks in (("mask", labels.masks), ("mask_visib", labels.visible_masks)):
            runs = {str(number): encode_runs(mask) for number, mask in enumerate(masks)}
            content[f"{name}.json"] = json.dumps(runs).encode()
        chunk, image = divmod(index, self.chunk_size)
        archive = io.BytesIO()
        with tarfile.open(fileobj=archive, mode="w") as tar:
            _add_image(tar, f"{chunk:06d}_{image:06d}", content)
        stage_item(self.staging(chunk) / f"{image:06d}.tar", archive.getvalue())

    def staging(self, chunk: int) -> Path:
        """Return the folder of a shard's staged images."""
        return self.root / self.split / STAGING / f"{chunk:06d}"

    def finalized(self, chunk: int) -> Iterable[int]:
        """Return the images in a shard."""
        path = self._shard(chunk)
        return {_image_number(member.key) for member in members(path)} if path.exists() else ()

    def merge(self, chunk: int, staged: Mapping[int, Path]) -> None:
        """Add staged images to the shard, and the shard's keys to ``key_to_shard.json``."""
        path = self._shard(chunk)
        if staged:
            # The webdataset library's TarWriter writes the same archive but imports torch.
            partial = partial_path(path)
            try:
                with tarfile.open(partial, "w", format=tarfile.USTAR_FORMAT) as archive:
                    for key, content in _merge_images([path, *staged.values()], chunk):
                        _add_image(archive, key, content)
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        # This also lists a shard that was finalized elsewhere and copied here.
        if path.exists():
            keys_path = path.with_name(KEY_FILE)
            shards = read_object(keys_path)
            merged = shards | {member.key: chunk for member in members(path)}
            if merged != shards:
                write_file(keys_path, encode_by_key(dict(sorted(merged.items()))))

    def _shard(self, chunk: int) -> Path:
        return self.root / self.split / f"shard-{chunk:06d}.tar"


def _merge_images(paths: Sequence[Path], chunk: int) -> Iterator[tuple[str, Content]]:
    """Yield key and files of each image by number; the last of several archives counts."""
    images: dict[int, tuple[Path, list[TarMember]]] = {}
    for path in paths:
        if path.exists():
            for key, group in groupby(members(path), key=lambda member: member.key):
                images[_image_number(key)] = path, list(group)
    for image, (path, listed) in sorted(images.items()):
        content = {m.extension: read_span(path, m.offset, m.size) for m in listed}
        yield f"{chunk:06d}_{image:06d}", content


def _add_image(archive: tarfile.TarFile, key: str, content: Content) -> None:
    """Add the files of one image to a tar file, in a fixed order and with fixed metadata."""
    for extension, data in sorted(content.items()):
        info = tarfile.TarInfo(f"{key}.{extension}")
        info.size, info.mode = len(data), 0o444
        info.uname = info.gname = _OWNER
        archive.addfile(info, io.BytesIO(data))


def _image_number(key: str) -> int:
    return int(key.rpartition("_")[2])
