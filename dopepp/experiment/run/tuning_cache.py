"""Cache in memory for the images and network outputs of tuning, which uses them several times."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Final, TypeVar

from dopepp.data.sample import Sample, SampleSource
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.runtimes import Runtime
from dopepp.metrics.pose import is_evaluated
from dopepp.models.heads import Stage
from dopepp.models.network import Images

MAX_BYTES: Final = 2**30
"""Size of the cache, bytes: 1,400 images of 400×400 pixels with the maps of one part."""

Made = TypeVar("Made")


class TuningCache:
    """Cache of at most ``max_bytes``; items that do not fit are computed each time."""

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._free = max_bytes
        self._items: dict[Hashable, Any] = {}

    def get(self, key: Hashable, make: Callable[[], Made], size: Callable[[Made], int]) -> Made:
        """Return the cached item of a key, or make and cache it; ``size`` returns its bytes."""
        if key in self._items:
            return self._items[key]  # type: ignore[no-any-return]
        item = make()
        if size(item) <= self._free:
            self._free -= size(item)
            self._items[key] = item
        return item

    def of(self, source: SampleSource, max_instances: int | None = None) -> SampleSource:
        """Return a source that caches its items.

        The source ends with the image that reaches ``max_instances`` evaluated instances.
        """
        cached = _CachedSource(source, self, source.name, len(source))
        if max_instances is not None:
            counts = (
                sum(map(is_evaluated, cached.sample(index).instances))
                for index in range(len(source))
            )
            reached = (n for n, total in enumerate(accumulate(counts), 1) if total >= max_instances)
            cached.length = next(reached, len(source))
        return cached

    def with_cached_maps(self, estimator: NetworkEstimator) -> NetworkEstimator:
        """Return a copy of an estimator that caches the network's maps of each input."""
        network, cached = estimator.network, copy.copy(estimator)
        cached.network = _CachedNetwork(network, self, network.stride, network.size_multiple)
        return cached


@dataclass
class _CachedSource:
    """The first ``length`` items of a source, cached."""

    source: SampleSource
    cache: TuningCache
    name: str
    length: int

    def __len__(self) -> int:
        return self.length

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return an item, from the cache if possible."""
        key = (id(self), index, epoch)
        return self.cache.get(key, lambda: self.source.sample(index, epoch), _num_bytes)


@dataclass
class _CachedNetwork:
    """Network whose output maps are cached, with a hash of the input's pixels as key."""

    network: Runtime
    cache: TuningCache
    stride: int
    size_multiple: int

    def maps(self, images: Images) -> Stage:
        """Return the network's maps of a batch of images, from the cache if possible."""
        pixels = images.permute(0, 2, 3, 1).contiguous().cpu().numpy()
        key = (id(self), pixels.shape, hashlib.blake2b(pixels.tobytes()).digest())
        return self.cache.get(
            key, lambda: self.network.maps(images), lambda maps: sum(part.nbytes for part in maps)
        )


def _num_bytes(sample: Sample) -> int:
    arrays = [sample.image, sample.depth, *(instance.mask for instance in sample.instances)]
    return sum(array.nbytes for array in arrays if array is not None)
