"""A batch: pixels and poses as tensors, padded to the largest number of instances in it.

Belief targets are not here: they are made on the training device from the keypoints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dopepp.data.sample import Sample

PADDING = -1
"""``object_index`` of a slot without an instance."""


@dataclass
class Batch:
    """Images of one size with their instances.

    Attributes:
        T_cam_obj: Rigid transforms, metres; the identity in padding.
        keypoints: Projected cuboids in pixels; NaN behind the camera and in padding.
        object_index: Position of the instance's object in the list of objects, −1 in padding.
        visible_fraction: Visible share of the silhouette, 0 in padding.
        masked_fraction: Share of the visible pixels covered by the random mask, 0 in padding.
    """

    images: UInt8[Tensor, "batch 3 height width"]
    K: Float[Tensor, "batch 3 3"]
    T_cam_obj: Float[Tensor, "batch instances 4 4"]
    keypoints: Float[Tensor, "batch instances 9 2"]
    object_index: Int[Tensor, "batch instances"]
    visible_fraction: Float[Tensor, "batch instances"]
    masked_fraction: Float[Tensor, "batch instances"]
    keys: list[str]
    sources: list[str]

    def __len__(self) -> int:
        return int(self.images.shape[0])

    def to(self, *args: Any, **kwargs: Any) -> Batch:
        """Move the tensors like ``Tensor.to(device, non_blocking=…)``; dtypes are kept."""
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def rows(self, index: Int[Tensor, " rows"]) -> Batch:
        """Return some of the images."""
        part = self._map(lambda tensor: tensor[index.to(tensor.device)])
        numbers = index.tolist()
        part.keys = [self.keys[number] for number in numbers]
        part.sources = [self.sources[number] for number in numbers]
        return part

    def pin_memory(self) -> Batch:
        """Copy the tensors into page-locked memory, for asynchronous transfer to a GPU."""
        return self._map(lambda tensor: tensor.pin_memory())

    def _map(self, function: Callable[[Tensor], Tensor]) -> Batch:
        values: dict[str, Any] = {
            entry.name: function(value) if isinstance(value, Tensor) else value
            for entry in fields(self)
            for value in [getattr(self, entry.name)]
        }
        return Batch(**values)


def collate(samples: Sequence[Sample], object_index: Mapping[str, int]) -> Batch:
    """Stack samples of one size.

    Args:
        samples: At least one sample; all of the same image size.
        object_index: Position of every object, by name.

    Raises:
        ValueError: The sizes differ, or an instance's object is not in ``object_index``.
    """
    sizes = {sample.size for sample in samples}
    if len(sizes) != 1:
        raise ValueError(f"a batch needs images of one size, got {sorted(sizes)}")
    unknown = {i.label for s in samples for i in s.instances} - set(object_index)
    if unknown:
        raise ValueError(f"objects {sorted(unknown)} are not among {list(object_index)}")
    images = torch.from_numpy(np.stack([sample.image for sample in samples]))
    return Batch(
        images=images.permute(0, 3, 1, 2),
        K=torch.from_numpy(np.stack([sample.K for sample in samples]).astype(np.float32)),
        keys=[sample.key for sample in samples],
        sources=[sample.source for sample in samples],
        **_stack_instances(samples, object_index),
    )


def _stack_instances(
    samples: Sequence[Sample], object_index: Mapping[str, int]
) -> dict[str, Tensor]:
    # One slot even when nothing is visible anywhere: an empty axis is a special case for everybody.
    shape = (len(samples), max(1, *(len(sample.instances) for sample in samples)))
    T_cam_obj = np.tile(np.eye(4, dtype=np.float32), (*shape, 1, 1))
    keypoints = np.full((*shape, 9, 2), np.nan, np.float32)
    index = np.full(shape, PADDING, np.int64)
    visible, masked = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for row, sample in enumerate(samples):
        for column, instance in enumerate(sample.instances):
            T_cam_obj[row, column] = instance.T_cam_obj
            keypoints[row, column] = instance.keypoints
            index[row, column] = object_index[instance.label]
            visible[row, column] = instance.visible_fraction
            masked[row, column] = instance.masked_fraction
    arrays = {
        "T_cam_obj": T_cam_obj,
        "keypoints": keypoints,
        "object_index": index,
        "visible_fraction": visible,
        "masked_fraction": masked,
    }
    return {name: torch.from_numpy(array) for name, array in arrays.items()}
