"""Keep rendered images in memory shared by all loader workers, so each is rendered once.

Cached renders ignore the epoch; masking and augmentation come after the cache and do not. Workers
must be forked: an anonymous shared map is inherited, not pickled.
"""

from __future__ import annotations

import mmap
import os
from dataclasses import replace
from typing import Any, Final

import numpy as np
from jaxtyping import Shaped

from dopepp.data.resize import resize_sample
from dopepp.data.sample import DescribedSource, Instance, Sample, SourceInfo
from dopepp.errors import UserError

_TEXT_LENGTH: Final = 64
_LAST_LABEL: Final = 255
"""Masks are kept as one uint8 map: 0 background, i + 1 instance i."""


def _shared(dtype: np.dtype[Any], num_items: int) -> Shaped[np.ndarray, " items"]:
    """Allocate zeros that forked processes share; pages are committed when first written."""
    return np.frombuffer(mmap.mmap(-1, dtype.itemsize * num_items), dtype)


class CachedSource:
    """A source whose items of epoch 0 are kept, resized to the network's input size.

    Any process fills any slot when it first needs it: the payload is written first, the flag last.
    Two processes that race write the same bytes, because an item is a pure function of its index.
    Depth is not kept.

    Args:
        source: The source to keep, of images of one size.
        input_size: (width, height) the images are shrunk to fit in, so no more than that is kept.
        max_instances: Instances a slot has room for, at most 255.

    Raises:
        ValueError: ``max_instances`` is too large, or an item does not fit into its slot.
        UserError: The cache would take more than half of the machine's memory.
    """

    def __init__(
        self, source: DescribedSource, input_size: tuple[int, int], max_instances: int = 8
    ) -> None:
        if max_instances > _LAST_LABEL:
            raise ValueError(f"max_instances={max_instances} is more than {_LAST_LABEL}")
        self._source, self._input_size, self._max_instances = source, input_size, max_instances
        self.name = source.name
        first = resize_sample(source.sample(0, 0), input_size)
        self._source_name = first.source
        self._shape = shape = first.image.shape[:2]
        instance = np.dtype(
            [
                ("T_cam_obj", "f8", (4, 4)),
                ("keypoints", "f8", (9, 2)),
                ("visible_fraction", "f8"),
                ("has_mask", "?"),
                ("label", f"U{_TEXT_LENGTH}"),
            ]
        )
        slot = np.dtype(
            [
                ("image", "u1", (*shape, 3)),
                ("labels", "u1", shape),
                ("K", "f8", (3, 3)),
                ("key", f"U{_TEXT_LENGTH}"),
                ("num_instances", "i4"),
                ("instances", instance, (max_instances,)),
            ]
        )
        self.num_bytes = slot.itemsize * len(source)
        _check_memory(self.num_bytes, len(source), source.name)
        self._slots = _shared(slot, len(source))
        self._ready = _shared(np.dtype("?"), len(source))
        self._store(0, first)

    def __len__(self) -> int:
        """Return the number of slots."""
        return len(self._source)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return a copy of item ``index``; the epoch is ignored."""
        if not self._ready[index]:
            self._store(index, resize_sample(self._source.sample(index, 0), self._input_size))
        return self._load(index)

    def contains(self, label: str) -> bool:
        """Tell what the kept source tells."""
        return self._source.contains(label)

    def describe(self) -> list[SourceInfo]:
        """Return what the kept source describes, marked as cached: its epochs are all the same."""
        return [
            replace(info, identity={**info.identity, "cache": "memory"})
            for info in self._source.describe()
        ]

    def _store(self, index: int, sample: Sample) -> None:
        self._check(sample)
        slot = self._slots[index]
        slot["image"], slot["K"], slot["key"] = sample.image, sample.K, sample.key
        labels = np.zeros(sample.image.shape[:2], np.uint8)
        for number, instance in enumerate(sample.instances):
            record = slot["instances"][number]
            for name in ("T_cam_obj", "keypoints", "visible_fraction", "label"):
                record[name] = getattr(instance, name)
            record["has_mask"] = instance.mask is not None
            if instance.mask is not None:
                labels[instance.mask] = number + 1
        slot["labels"], slot["num_instances"] = labels, len(sample.instances)
        self._ready[index] = True

    def _check(self, sample: Sample) -> None:
        """Refuse what a slot would cut off or mix up without a word."""
        if len(sample.instances) > self._max_instances:
            raise ValueError(
                f"{len(sample.instances)} instances; max_instances={self._max_instances}"
            )
        if sample.image.shape[:2] != self._shape or sample.source != self._source_name:
            raise ValueError(
                f"a {sample.size} image of {sample.source}; a cache keeps one size and one source"
            )
        texts = [sample.key, *(instance.label for instance in sample.instances)]
        if max(map(len, texts)) > _TEXT_LENGTH:
            raise ValueError(f"one of {texts} has more than {_TEXT_LENGTH} characters")

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
            source=self._source_name,
            key=str(slot["key"]),
        )


def _check_memory(num_bytes: int, num_items: int, source: str) -> None:
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if num_bytes > available / 2:
        raise UserError(
            f"data.cache=memory for {num_items} images of {source}: {num_bytes / 1e9:.1f} GB",
            f"at most half of this machine's {available / 1e9:.1f} GB",
            "set data.cache=none, a smaller input size or fewer samples per epoch",
        )
