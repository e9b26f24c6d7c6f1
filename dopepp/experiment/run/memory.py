"""Rendered pictures and a network's maps, made once: tuning uses each two to four times."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from dopepp.data.sample import Sample, SampleSource
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.runtimes import Runtime
from dopepp.models.heads import Stage
from dopepp.models.network import Images

MOST_BYTES: Final = 2**30
"""Of all that is kept: 1,400 pictures of 400×400 pixels, with the maps of one part."""

Made = TypeVar("Made")


class Memory:
    """Keeps what was made, first come, first kept; what does not fit is made again."""

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

    def of(self, source: SampleSource) -> SampleSource:
        """Return a source whose items of epoch 0 are made once."""
        return _RememberedSource(source, self, source.name)

    def behind(self, estimator: PoseEstimator) -> PoseEstimator:
        """Return a copy of an estimator that runs its network once on each picture."""
        network, remembering = estimator.network, copy.copy(estimator)
        remembering.network = _RememberedNetwork(
            network, self, network.stride, network.size_multiple
        )
        return remembering


@dataclass
class _RememberedSource:
    source: SampleSource
    memory: Memory
    name: str

    def __len__(self) -> int:
        return len(self.source)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        if epoch:
            return self.source.sample(index, epoch)
        return self.memory.recall((id(self), index), lambda: self.source.sample(index), _num_bytes)


@dataclass
class _RememberedNetwork:
    network: Runtime
    memory: Memory
    stride: int
    size_multiple: int

    def maps(self, images: Images) -> Stage:
        pixels = images.permute(0, 2, 3, 1).contiguous().cpu().numpy()
        key = (id(self), pixels.shape, hashlib.blake2b(pixels.tobytes()).digest())
        return self.memory.recall(
            key, lambda: self.network.maps(images), lambda maps: sum(each.nbytes for each in maps)
        )


def _num_bytes(sample: Sample) -> int:
    arrays = [sample.image, sample.depth, *(each.mask for each in sample.instances)]
    return sum(each.nbytes for each in arrays if each is not None)
