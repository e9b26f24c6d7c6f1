"""What is asked for several times and made once: rendered pictures and a network's maps.

Tuning looks at each picture two to four times, with other options. What does not fit into memory is
made again.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable, Hashable
from typing import Any, Final, TypeVar

from dopepp.data.sample import Sample, Source
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.runtimes.runtime import Runtime
from dopepp.models.heads import Stage
from dopepp.models.network import Images

MOST_BYTES: Final = 2**30
"""Of all that is kept: 1,400 pictures of 400×400 pixels, with the maps of one part."""

Made = TypeVar("Made")


class Memory:
    """Keeps what was made, first come, first kept, up to so many bytes."""

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self._free = most_bytes
        self._kept: dict[Hashable, Any] = {}

    def recall(self, key: Hashable, make: Callable[[], Made], size: Callable[[Made], int]) -> Made:
        """Return what was made under a key before, or make it; ``size`` says how many bytes."""
        if key in self._kept:
            return self._kept[key]  # type: ignore[no-any-return]
        made = make()
        if size(made) <= self._free:
            self._free -= size(made)
            self._kept[key] = made
        return made

    def of(self, source: Source) -> Source:
        """Return a source whose items of epoch 0 are made once."""
        return _RememberedSource(source, self)

    def behind(self, estimator: PoseEstimator) -> PoseEstimator:
        """Return a copy of an estimator that runs its network once on each picture."""
        remembering = copy.copy(estimator)
        remembering.network = _RememberedNetwork(estimator.network, self)
        return remembering


class _RememberedSource:
    def __init__(self, source: Source, memory: Memory) -> None:
        self.name, self._source, self._memory = source.name, source, memory

    def __len__(self) -> int:
        return len(self._source)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return item ``index`` of ``epoch``."""
        if epoch:
            return self._source.sample(index, epoch)
        return self._memory.recall((id(self), index), lambda: self._source.sample(index), _bytes_of)


class _RememberedNetwork:
    def __init__(self, network: Runtime, memory: Memory) -> None:
        self.stride, self.size_multiple = network.stride, network.size_multiple
        self._network, self._memory = network, memory

    def maps(self, images: Images) -> Stage:
        """Return the belief maps and the vector field of images."""
        pixels = images.permute(0, 2, 3, 1).contiguous().cpu().numpy()
        key = (id(self), pixels.shape, hashlib.blake2b(pixels.tobytes()).digest())
        return self._memory.recall(
            key, lambda: self._network.maps(images), lambda maps: sum(one.nbytes for one in maps)
        )


def _bytes_of(sample: Sample) -> int:
    """Return the size of a sample's pictures."""
    arrays = [sample.image, sample.depth, *(one.mask for one in sample.instances)]
    return sum(one.nbytes for one in arrays if one is not None)
