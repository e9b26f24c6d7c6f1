"""Provide virtual images as a source, rendered on demand or cached.

Training, validation and test are disjoint index ranges of a factory. Only training images change
with the epoch. The cache holds images of epoch 0; masking and augmentation follow the cache.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import os
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Shaped

from dopepp.core.errors import UserError
from dopepp.core.files import draft, write_file
from dopepp.core.pool import in_forked_process
from dopepp.data.sample import (
    DescribedSource,
    Instance,
    Sample,
    SourceInfo,
    WrappedSource,
    resize_sample,
)
from dopepp.drawing.pictures import Shape, Size
from dopepp.virtual.factory import Factory
from dopepp.virtual.renderers import survives_fork
from dopepp.virtual.scene import Rendered

Split = Literal["train", "val", "test"]

MAX_ITEMS: Final = 1_000_000_000
FIRST_INDEX: Final[dict[Split, int]] = {"train": 0, "val": MAX_ITEMS, "test": 2 * MAX_ITEMS}
"""First factory index of each split; no split may hold more than ``MAX_ITEMS`` items."""


class RenderedSource:
    """Source of the images of one split, which a factory renders on demand.

    Args:
        split: One of the three disjoint index ranges; ``val`` and ``test`` ignore the epoch.
        scale: Factor by which the camera is closer to the mean of the targets' centres.
    """

    def __init__(
        self,
        factory: Factory,
        num_items: int,
        split: Split = "train",
        name: str = "virtual",
        scale: float = 1.0,
    ) -> None:
        self.factory, self.split, self.name, self.scale = factory, split, name, scale
        self._num_items = num_items

    def __len__(self) -> int:
        return self._num_items

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Render image ``index`` of the split.

        Raises:
            IndexError: The index is negative, or not below the number of items.
        """
        if not 0 <= index < self._num_items:  # would be an image of another split
            raise IndexError(f"index {index} is out of range for {self._num_items} items")
        epoch = epoch if self.split == "train" else 0
        rendered = self.factory.render(epoch, FIRST_INDEX[self.split] + index, self.scale)
        return rendered_sample(rendered, self.name, f"{self.split}/{epoch}/{index}")

    def contains(self, label: str) -> bool:
        """Return whether the part named ``label`` is a target of the factory."""
        return any(part.name == label for part in self.factory.parts)

    def describe(self) -> list[SourceInfo]:
        """Return one entry: the split, the factory's settings, and hashes of the parts' meshes."""
        identity: dict[str, object] = {
            "split": self.split,
            "seed": self.factory.seed,
            "preset": repr(self.factory.preset),
            "backgrounds": self.factory.backgrounds.identity(),
            "renderer": self.factory.renderer,
            "parts": {part.name: part.mesh_hash for part in self.factory.parts},
            "negatives": {part.name: part.mesh_hash for part in self.factory.negatives},
        }
        # The default adds no key, so that older renders keep their identity.
        if self.scale != 1:
            identity["scale"] = self.scale
        return [SourceInfo(self.name, self._num_items, identity)]


def rendered_sample(rendered: Rendered, source: str, key: str) -> Sample:
    """Convert a rendered image to a sample with all its targets, even fully occluded targets."""
    scene = rendered.scene
    instances = [
        Instance(
            label=scene.objects[number].label,
            T_cam_obj=np.asarray(scene.objects[number].T_cam_obj, np.float64),
            keypoints=scene.keypoints(number),
            visible_fraction=float(rendered.visible_fractions[number]),
            mask=rendered.instances == number,
        )
        for number in scene.targets
    ]
    return Sample(rendered.image, scene.K, instances, rendered.depth, source, key)


_TEXT_LENGTH: Final = 64
MAX_LABELLED: Final = 40  # instances per labelled image that a cache holds

_FILLED: Final = 1 << 32  # added to a slot's CRC-32, so that only an empty slot has the checksum 0


class CachedSource(WrappedSource):
    """Cache of another source's samples of epoch 0, resized to fit the network's input.

    The cache is an array with a slot for each item, in memory shared by forked workers or in a file
    shared by runs. The first request for an item fills its slot: the content, then the checksum. A
    slot with a wrong checksum, left by a killed process, is filled again. No lock is needed, as
    processes that fill a slot simultaneously write the same bytes.

    Args:
        input_size: (width, height) that bounds the resized images, which lose their depth; None
            keeps size and depth.
        folder: Folder of the files, in subfolders named by a hash of everything that determines the
            items (besides the source, ``identity``); None keeps the items in memory.
        max_instances: Largest number of instances in an image, at most 255.

    Raises:
        UserError: The cache needs more than half of the machine's memory, or the disk is full; or,
            also in :meth:`sample`, a slot cannot hold an item.
    """

    def __init__(
        self,
        source: DescribedSource,
        input_size: Size | None,
        folder: Path | None = None,
        identity: str = "",
        max_instances: int = MAX_LABELLED,
    ) -> None:
        super().__init__(source, cached=True)  # all epochs are equal
        self._input_size, self._max_instances = input_size, max_instances
        # The loader's workers fork this process.
        is_forked = isinstance(source, RenderedSource) and not survives_fork(
            source.factory.renderer
        )
        first = in_forked_process(self._resized, 0) if is_forked else self._resized(0)
        self._source_name = first.source
        self._shape, self._has_depth = first.image.shape[:2], first.depth is not None
        slot = _slot_layout(self._shape, self._has_depth, max_instances)
        self.num_bytes = slot.itemsize * len(source)
        self.folder = None
        if folder is None:
            available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
            if self.num_bytes > available / 2:
                size = f"{self.num_bytes / 1e9:.1f} GB"
                problem = f"data.cache=memory for {len(source)} images of {source.name} ({size})"
                allowed = f"at most half of this machine's {available / 1e9:.1f} GB"
                settings = "data.input_size or data.samples_per_epoch"
                fix = f"set data.cache=none or disk, or lower {settings}"
                raise UserError(problem, allowed, fix)
        else:
            described = [[info.name, info.num_images, info.identity] for info in source.describe()]
            record = {"items": described, "identity": identity, "slot": str(slot.descr)}
            text = json.dumps(record, sort_keys=True, indent=1)
            self.folder = folder / hashlib.sha256(text.encode()).hexdigest()[:24]
        self._slots = self._shared_array("slots.bin", slot)
        self._checksums = self._shared_array("checksums.bin", np.dtype("u8"))
        if self.folder is not None:
            write_file(self.folder / "identity.json", text.encode())
        self._store(0, first)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return a copy of item ``index``; the epoch is ignored."""
        checksum = self._checksums[index]
        if not checksum or checksum != self._checksum(index):
            self._store(index, self._resized(index))
        return self._load(index)

    def _shared_array(self, name: str, dtype: np.dtype[Any]) -> Shaped[np.ndarray, " items"]:
        """Return an array of one entry per item, initially 0, in shared memory or a file."""
        size = dtype.itemsize * len(self._source)
        if self.folder is None:
            return np.frombuffer(mmap.mmap(-1, size), dtype)  # only written pages take memory
        path = self.folder / name
        try:
            if not path.is_file() or path.stat().st_size != size:
                with draft(path) as partial, partial.open("wb") as file:
                    # Allocated now, because a full disk under a file with holes kills the process.
                    os.posix_fallocate(file.fileno(), 0, size)
            with path.open("r+b") as file:
                return np.frombuffer(mmap.mmap(file.fileno(), size), dtype)
        except OSError as error:
            problem = f"data.cache=disk, {size / 1e9:.2f} GB in {path.parent}: {error.strerror}"
            fix = "set data.cache_dir to another disk, or data.cache=none"
            raise UserError(problem, "a folder with at least this much free space", fix) from error

    def _resized(self, index: int) -> Sample:
        sample = self._source.sample(index, 0)
        if self._input_size is None:
            return sample
        return replace(resize_sample(sample, self._input_size), depth=None)

    def _checksum(self, index: int) -> int:
        return zlib.crc32(self._slots[index : index + 1].view("u1").data) | _FILLED

    def _store(self, index: int, sample: Sample) -> None:
        """Write a sample to its slot, and then the slot's checksum.

        Raises:
            UserError: A slot cannot hold the sample.
        """
        texts = [sample.key, *(instance.label for instance in sample.instances)]
        layout = (self._shape, self._source_name, self._has_depth)
        allowed = ""
        if (sample.image.shape[:2], sample.source, sample.depth is not None) != layout:
            allowed = "images of one size and source, all with depth or all without"
        elif len(texts) > self._max_instances + 1 or max(map(len, texts)) > _TEXT_LENGTH:
            allowed = (
                f"at most {self._max_instances} instances, and names of {_TEXT_LENGTH} letters"
            )
        if allowed:
            width, height = sample.size
            problem = (
                f"data.cache={'memory' if self.folder is None else 'disk'} for image {sample.key} "
                f"of {sample.source}, scaled to {width}×{height}, with {len(texts) - 1} instances"
            )
            raise UserError(problem, allowed, "set data.cache=none")
        slot = self._slots[index]
        slot["image"], slot["K"], slot["key"] = sample.image, sample.K, sample.key
        labels = np.zeros(sample.image.shape[:2], np.uint8)  # 0 for the background
        for number, instance in enumerate(sample.instances):
            record = slot["instances"][number]
            for name in ("T_cam_obj", "keypoints", "visible_fraction", "label"):
                record[name] = getattr(instance, name)
            record["has_mask"] = instance.mask is not None
            if instance.mask is not None:
                labels[instance.mask] = number + 1
        slot["labels"], slot["num_instances"] = labels, len(sample.instances)
        if sample.depth is not None:
            slot["depth"] = sample.depth
        self._checksums[index] = self._checksum(index)

    def _load(self, index: int) -> Sample:
        slot = self._slots[index]
        instances = [
            Instance(
                label=str(record["label"]),
                T_cam_obj=record["T_cam_obj"].copy(),
                keypoints=record["keypoints"].copy(),
                visible_fraction=float(record["visible_fraction"]),
                mask=slot["labels"] == number + 1 if record["has_mask"] else None,
            )
            for number, record in enumerate(slot["instances"][: slot["num_instances"]])
        ]
        return Sample(
            slot["image"].copy(),
            slot["K"].copy(),
            instances,
            slot["depth"].copy() if self._has_depth else None,
            source=self._source_name,
            key=str(slot["key"]),
        )


def _slot_layout(shape: Shape, has_depth: bool, max_instances: int) -> np.dtype[Any]:
    """Return the dtype of a slot: one sample with an image of ``shape``."""
    instance: list[tuple[Any, ...]] = [("T_cam_obj", "f8", (4, 4)), ("keypoints", "f8", (9, 2))]
    instance += [("visible_fraction", "f8"), ("has_mask", "?"), ("label", f"U{_TEXT_LENGTH}")]
    fields: list[tuple[Any, ...]] = [
        ("image", "u1", (*shape, 3)),
        ("labels", "u1", shape),
        ("K", "f8", (3, 3)),
    ]
    fields += [("key", f"U{_TEXT_LENGTH}"), ("num_instances", "i4")]
    fields += [("instances", instance, (max_instances,))]
    return np.dtype(fields + ([("depth", "f4", shape)] if has_depth else []))
