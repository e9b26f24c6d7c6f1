"""Collate samples into a batch of tensors, padded to the largest number of instances.

The training computes the target belief maps from the keypoints, on its device.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dopepp.data.sample import Sample

PADDING = -1  # ``object_index`` of a slot without an instance


@dataclass
class Batch:
    """Images of one size with their instances.

    Attributes:
        images: RGB.
        K: Camera matrices, pixels.
        T_cam_obj: Rigid transforms, metres; the identity in padding.
        keypoints: Projected cuboids in pixels; NaN behind the camera and in padding.
        object_index: Index of the instance's object among the network's objects, −1 in padding.
        visible_fraction: See ``Instance``; 0 in padding.
    """

    images: UInt8[Tensor, "batch 3 height width"]
    K: Float[Tensor, "batch 3 3"]
    T_cam_obj: Float[Tensor, "batch instances 4 4"]
    keypoints: Float[Tensor, "batch instances 9 2"]
    object_index: Int[Tensor, "batch instances"]
    visible_fraction: Float[Tensor, "batch instances"]
    keys: list[str]
    sources: list[str]

    def __len__(self) -> int:
        return int(self.images.shape[0])

    def to(self, *args: Any, **kwargs: Any) -> Batch:
        """Move the tensors like ``Tensor.to(device, non_blocking=…)``; dtypes are kept."""
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def rows(self, index: Int[Tensor, " rows"]) -> Batch:
        """Return the batch of the images with these indices."""
        part = self._map(lambda tensor: tensor[index.to(tensor.device)])
        part.keys = [self.keys[number] for number in index.tolist()]
        part.sources = [self.sources[number] for number in index.tolist()]
        return part

    def pin_memory(self) -> Batch:
        """Copy the tensors into page-locked memory, for asynchronous transfer to a GPU."""
        return self._map(lambda tensor: tensor.pin_memory())

    def _map(self, function: Callable[[Tensor], Tensor]) -> Batch:
        tensors: dict[str, Any] = {
            name: function(value) for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **tensors)


def collate(samples: Sequence[Sample], object_index: Mapping[str, int]) -> Batch:
    """Stack samples of one image size; ``object_index`` maps labels to indices of objects."""
    # At least one slot, because code that uses batches does not handle an empty axis.
    shape = (len(samples), max(1, *(len(sample.instances) for sample in samples)))
    fields = {
        "T_cam_obj": np.tile(np.eye(4, dtype=np.float32), (*shape, 1, 1)),
        "keypoints": np.full((*shape, 9, 2), np.nan, np.float32),
        "visible_fraction": np.zeros(shape, np.float32),
    }
    index = np.full(shape, PADDING, np.int64)
    for row, sample in enumerate(samples):
        for column, instance in enumerate(sample.instances):
            index[row, column] = object_index[instance.label]
            for name, array in fields.items():
                array[row, column] = getattr(instance, name)
    images = torch.from_numpy(np.stack([sample.image for sample in samples]))
    return Batch(
        images=images.permute(0, 3, 1, 2),
        K=torch.from_numpy(np.stack([sample.K for sample in samples]).astype(np.float32)),
        object_index=torch.from_numpy(index),
        keys=[sample.key for sample in samples],
        sources=[sample.source for sample in samples],
        **{name: torch.from_numpy(array) for name, array in fields.items()},
    )
