"""Write BOP-WebDataset shards: stage items, and finalize shard by shard.

``train_pbr/shard-000012.tar`` holds images 12,000 – 12,999 in order. ``key_to_shard.json`` lists
the shard of each key. ``models/`` lies next to the split as in BOP's scenewise layout. Until the
shard is finalized, each image is a small archive in the hidden folder ``.items``.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import Final

from dopepp.core.files import partial_path, write_file
from dopepp.data.formats import (
    STAGING,
    encode_by_key,
    lock_staging,
    read_object,
    stage_item,
    staged_items,
)
from dopepp.data.formats.bop.bop_writer import BopFolder
from dopepp.data.formats.images import encode_png, encode_runs
from dopepp.data.formats.webdataset import KEY_FILE, TarMember, members, read_span
from dopepp.data.sample import Sample

_OWNER: Final = "dopepp"  # A fixed owner and a modification time of 0 give equal images equal bytes
Content = dict[str, bytes]  # an image's members by extension


class WebdatasetWriter(BopFolder):
    """A :class:`~dopepp.data.formats.Writer` of BOP-WebDataset shards."""

    name = "webdataset"

    def write(self, index: int, sample: Sample) -> None:
        """Write an image's archive to the staging folder, from which :meth:`finalize` reads it."""
        labels = self.labels(sample)
        content = {
            "rgb.png": encode_png(sample.image),
            "depth.png": encode_png(labels.depth),
            "camera.json": json.dumps(labels.camera).encode(),
            "gt.json": json.dumps(labels.truths).encode(),
            "gt_info.json": json.dumps(labels.infos).encode(),
        }
        for name, masks in (("mask", labels.masks), ("mask_visib", labels.visible_masks)):
            runs = {str(number): encode_runs(mask) for number, mask in enumerate(masks)}
            content[f"{name}.json"] = json.dumps(runs).encode()
        chunk, image = divmod(index, self.chunk_size)
        stage_item(
            self._staging(chunk) / f"{image:06d}.tar", _archive(f"{chunk:06d}_{image:06d}", content)
        )

    def written(self, chunk: int) -> set[int]:
        """Return the indices of the shard's images that are staged or finalized."""
        images = {int(path.stem) for path in self._staged(chunk)}
        if self._shard(chunk).exists():
            images |= {_image_number(member.key) for member in members(self._shard(chunk))}
        return {chunk * self.chunk_size + image for image in images}

    def finalize(self, chunk: int, indices: Sequence[int]) -> None:
        """Merge the staged images into the shard and into ``key_to_shard.json``."""
        image_numbers = {index % self.chunk_size for index in indices}
        with lock_staging(self.root / self.split / STAGING):
            staged = {int(path.stem): path for path in self._staged(chunk)}
            staged = {image: path for image, path in staged.items() if image in image_numbers}
            if staged:
                self._write_shard(chunk, staged)
            # This also adds a shard that was finalized elsewhere and copied here.
            self._write_keys(chunk)
            for path in staged.values():
                path.unlink()
            with suppress(OSError):  # the folder is missing, or has items left
                self._staging(chunk).rmdir()

    def _write_shard(self, chunk: int, staged: dict[int, Path]) -> None:
        """Write a shard of its earlier images, if any, and of the staged images."""
        # The webdataset library's TarWriter writes the same archive but imports torch.
        path = self._shard(chunk)
        partial = partial_path(path)
        try:
            with tarfile.open(partial, "w", format=tarfile.USTAR_FORMAT) as archive:
                for key, content in _merge_images([path, *staged.values()], chunk):
                    _add_image(archive, key, content)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)

    def _write_keys(self, chunk: int) -> None:
        if not self._shard(chunk).exists():
            return
        path = self.root / self.split / KEY_FILE
        shards = read_object(path)
        merged = shards | {member.key: chunk for member in members(self._shard(chunk))}
        if merged != shards:
            write_file(path, encode_by_key(dict(sorted(merged.items()))))

    def _shard(self, chunk: int) -> Path:
        return self.root / self.split / f"shard-{chunk:06d}.tar"

    def _staging(self, chunk: int) -> Path:
        return self.root / self.split / STAGING / f"{chunk:06d}"

    def _staged(self, chunk: int) -> list[Path]:
        return staged_items(self._staging(chunk), ".tar")


def _merge_images(paths: Sequence[Path], chunk: int) -> Iterator[tuple[str, Content]]:
    """Yield key and files of each image of the existing archives, by image number.

    If several archives hold an image, its files in the last archive are used. One image is in
    memory at a time.
    """
    images: dict[int, tuple[Path, list[TarMember]]] = {}
    for path in paths:
        if path.exists():
            for key, group in groupby(members(path), key=lambda member: member.key):
                images[_image_number(key)] = path, list(group)
    for image, (path, listed) in sorted(images.items()):
        content = {m.extension: read_span(path, m.offset, m.size) for m in listed}
        yield f"{chunk:06d}_{image:06d}", content


def _archive(key: str, content: Content) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        _add_image(archive, key, content)
    return buffer.getvalue()


def _add_image(archive: tarfile.TarFile, key: str, content: Content) -> None:
    """Add the files of one image to a tar file, in a fixed order and with fixed metadata."""
    for extension, data in sorted(content.items()):
        info = tarfile.TarInfo(f"{key}.{extension}")
        info.size, info.mode = len(data), 0o444
        info.uname = info.gname = _OWNER
        archive.addfile(info, io.BytesIO(data))


def _image_number(key: str) -> int:
    return int(key.rpartition("_")[2])
