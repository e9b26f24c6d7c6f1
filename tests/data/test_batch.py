from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from dopepp.data.batch import PADDING, Batch, collate


def test_collate_pads_instances(fake_source: Any) -> None:
    source = fake_source()
    one, none, two = source.sample(0), source.sample(1), source.sample(2)
    none.instances = []
    two.instances.append(replace(two.instances[0], label="can", masked_fraction=0.25))
    batch = collate([one, none, two], {"can": 0, "box": 1})
    assert batch.object_index.tolist() == [[1, PADDING], [PADDING] * 2, [1, 0]]
    assert batch.images.dtype == torch.uint8
    assert batch.images.shape == (3, 3, 48, 64)
    assert batch.images.is_contiguous(memory_format=torch.channels_last)
    np.testing.assert_array_equal(batch.images[2].permute(1, 2, 0).numpy(), two.image)
    np.testing.assert_allclose(batch.K[0].numpy(), one.K)
    np.testing.assert_allclose(batch.T_cam_obj[2, 1].numpy(), two.instances[1].T_cam_obj, rtol=1e-6)
    np.testing.assert_allclose(batch.keypoints[0, 0].numpy(), one.instances[0].keypoints, rtol=1e-6)
    padding = batch.object_index == PADDING
    assert batch.keypoints[padding].isnan().all()
    assert not batch.keypoints[~padding].isnan().any()
    assert (batch.T_cam_obj[padding] == torch.eye(4)).all()
    assert batch.visible_fraction[padding].eq(0).all()
    assert batch.masked_fraction[2].tolist() == [0.0, 0.25]
    assert batch.keys == ["0/0", "0/1", "0/2"]
    assert batch.sources == ["fake"] * 3
    assert len(batch) == 3


def test_a_batch_without_instances_keeps_one_padding_slot(fake_source: Any) -> None:
    sample = fake_source().sample(0)
    sample.instances = []
    assert collate([sample, sample], {"box": 0}).object_index.tolist() == [[PADDING], [PADDING]]


def test_to_moves_tensors_and_keeps_the_rest(fake_source: Any) -> None:
    batch = collate([fake_source().sample(0)], {"box": 0})
    moved = batch.to("meta", non_blocking=True)
    assert isinstance(moved, Batch)
    assert moved.images.device.type == moved.object_index.device.type == "meta"
    assert moved.object_index.dtype == torch.int64
    assert moved.keys == batch.keys


def test_wrong_sizes_and_labels_are_refused(fake_source: Any) -> None:
    samples = [fake_source(size=(64, 48)).sample(0), fake_source(size=(48, 48)).sample(0)]
    with pytest.raises(ValueError, match="images of one size"):
        collate(samples, {"box": 0})
    with pytest.raises(ValueError, match=r"\['box'\] are not among \['can'\]"):
        collate(samples[:1], {"can": 0})
