import math
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from dopepp.core.errors import UserError
from dopepp.data.batch import PADDING, Batch, collate
from dopepp.data.datamodule import EpochSampler, PoseDataModule, SampleDataset
from dopepp.data.rendered import CachedSource
from dopepp.data.transforms.augment import Photometric
from dopepp.data.transforms.masking import RandomMask
from dopepp.parts.part import make_part
from dopepp.parts.size import LearnedRange
from dopepp.virtual.backgrounds import ProceduralBackgrounds


@pytest.fixture
def build(fake_source):
    def build(**changes):
        options = {
            "train": fake_source(12), "val": fake_source(5), "test": fake_source(3, size=(96, 72)),
            "object_names": ["box"], "input_size": (64, 64), "batch_size": 4,
            "masking": RandomMask(0.7), "augment": Photometric(),
            "backgrounds": ProceduralBackgrounds(),
        }  # fmt: skip
        return PoseDataModule(**(options | changes))

    return build


def batches(datamodule: PoseDataModule, epoch: int) -> list[Batch]:
    loader = datamodule.train_dataloader()
    loader.sampler.set_epoch(epoch)
    return list(loader)


def assert_same(first: list[Batch], second: list[Batch]) -> None:
    for left, right in zip(first, second, strict=True):
        for entry in fields(Batch):
            a, b = getattr(left, entry.name), getattr(right, entry.name)
            is_tensor = isinstance(a, Tensor)
            assert torch.equal(a.nan_to_num(), b.nan_to_num()) if is_tensor else a == b


@pytest.mark.parametrize("cached", [False, True])
def test_workers_do_not_change_the_batches(build, fake_source, cached):
    def train():
        return CachedSource(fake_source(12), (64, 64)) if cached else fake_source(12)

    alone = build(train=train())
    together = build(train=train(), num_workers=2)
    loader = together.train_dataloader()
    for epoch in range(2):  # the second pass reuses the persistent workers
        loader.sampler.set_epoch(epoch)
        assert_same(batches(alone, epoch), list(loader))


def test_epochs_differ_and_repeat(build):
    def keys(epoch, **options):
        return [key for batch in batches(build(**options), epoch) for key in batch.keys]

    datamodule = build()
    assert_same(batches(datamodule, 0), batches(datamodule, 0))
    first, second = keys(0), keys(1)
    assert sorted(first) == sorted(f"0/{i}" for i in range(12))
    assert sorted(second) == sorted(f"1/{i}" for i in range(12))
    assert [key[2:] for key in first] != [key[2:] for key in second]
    assert keys(0, seed=1) != first


def test_cached_images_keep_their_epoch_but_not_their_augmentation(build, fake_source):
    datamodule = build(train=CachedSource(fake_source(12), (64, 64)))
    first, second = datamodule.train_item(0, 3), datamodule.train_item(1, 3)
    assert first.key == second.key == "0/3"
    assert (first.image != second.image).any()
    np.testing.assert_array_equal(first.instances[0].keypoints, second.instances[0].keypoints)


def test_padding_is_neither_augmented_nor_masked(build):
    for index in range(12):
        assert not build().train_item(0, index).image[48:].any()


def test_validation_images_are_unchanged_and_test_images_have_native_size(build, fake_source):
    datamodule = build()
    keys = []
    for batch in datamodule.val_dataloader():
        keys += batch.keys
        for image, key in zip(batch.images, batch.keys, strict=True):
            expected = fake_source(5).sample(int(key.split("/")[1]), 0).image
            np.testing.assert_array_equal(image[:, :48].permute(1, 2, 0).numpy(), expected)
    assert keys == [f"0/{i}" for i in range(5)]
    assert [datamodule.test_source.sample(i, 0).size for i in range(3)] == [(96, 72)] * 3


@pytest.mark.parametrize("shuffle", [True, False])
@pytest.mark.parametrize("num_items", [12, 13])
def test_ranks_share_the_items(fake_source, shuffle, num_items):
    dataset = SampleDataset(lambda epoch, index: fake_source().sample(index, epoch), num_items)
    ranks = [EpochSampler(dataset, 0, shuffle, rank, 3) for rank in range(3)]
    for sampler in ranks:
        sampler.set_epoch(2)
    parts = [list(sampler) for sampler in ranks]
    assert [len(part) for part in parts] == [len(sampler) for sampler in ranks]
    union = [item for part in parts for item in part]
    assert len(set(union)) == len(union)
    assert {epoch for epoch, _ in union} == {2 if shuffle else 0}
    if shuffle:
        assert {len(part) for part in parts} == {num_items // 3}
    else:
        assert sorted(index for _, index in union) == list(range(num_items))


@pytest.mark.parametrize(("batch_size", "common"), [(1, 2), (2, 1), (3, 1)])
def test_ranks_know_how_many_validation_batches_all_have(build, batch_size, common):
    datamodule, lengths = build(batch_size=batch_size), []
    for rank in range(2):
        datamodule.trainer = SimpleNamespace(global_rank=rank, world_size=2)
        loader = datamodule.val_dataloader()
        lengths.append(len(loader))
        assert loader.num_common_batches == common
    assert min(lengths) == common


@pytest.mark.parametrize("num_workers", [0, 2])
def test_a_user_error_of_a_worker_is_raised_as_one_line(build, fake_source, num_workers):
    error = UserError("frame 7", "complete frames", "download it again")
    source = fake_source(12, bad=lambda index: error if index == 7 else None)
    with pytest.raises(UserError, match=r"^got frame 7; allowed: complete frames") as caught:
        batches(build(train=source, num_workers=num_workers), 0)
    assert "\n" not in str(caught.value)


def test_summary_and_fingerprint(build, fake_source):
    rows = build().summary()
    images = [(split, info.name, info.num_images) for split, info in rows]
    assert images == [("train", "fake", 12), ("val", "fake", 5), ("test", "fake", 3)]
    assert rows[0][1].num_instances == {"box": 1}
    fingerprint = build().fingerprint()
    assert len(fingerprint) == 64
    assert build().fingerprint() == fingerprint
    assert build(seed=1).fingerprint() != fingerprint
    assert build(val=fake_source(6)).fingerprint() != fingerprint


def test_size_ranges_are_measured_on_validation_images(build, fake_source):
    part = make_part("box", None, np.array([[0.0, 0, 0], [0.1, 0.1, 0.2]]))
    samples = [fake_source(5).sample(index) for index in range(5)]
    depths = [(s.instances[0].T_cam_obj @ [*part.cuboid[8], 1])[2] for s in samples]
    near, far, K = min(depths), max(depths), samples[0].K
    focal = math.sqrt(K[0, 0] * K[1, 1]) * 64 / max(samples[0].size)
    ranges = build().size_ranges([part, replace(part, name="can")])
    expected = (focal * part.diameter / far, focal * part.diameter / near, near, far)
    assert ranges == {"box": pytest.approx(expected)}


def test_sizes_of_instances_that_no_image_shows_are_ignored(build, fake_source):
    part = make_part("box", None, np.array([[0.0, 0, 0], [0.1, 0.1, 0.2]]))
    source = fake_source(5)
    visible = build(val=source).size_ranges([part])
    make = source.sample

    def with_hidden(index, epoch=0):
        sample = make(index, epoch)
        shown = sample.instances[0]
        behind, far = shown.T_cam_obj.copy(), shown.T_cam_obj.copy()
        behind[2, 3], far[2, 3] = -1.0, 1e3
        hidden = [
            replace(shown, T_cam_obj=behind),
            replace(shown, T_cam_obj=far, visible_fraction=0.0),
        ]
        return replace(sample, instances=[shown, *hidden])

    source.sample = with_hidden
    assert build(val=source).size_ranges([part]) == visible
    assert LearnedRange.parse([*LearnedRange.of(1e-3, 2e4)]) == (0.1, 0.1, 1e4, 1e4)


def test_an_object_without_any_instance_fails_at_start(build):
    build().check_objects()
    with pytest.raises(UserError, match=r"no instance of can in the training data \(fake\)"):
        build(object_names=["box", "can"]).check_objects()


def test_wrong_options(build):
    with pytest.raises(UserError, match="12 training images for batches of 13"):
        build(batch_size=13)
    divided = build(batch_size=8)
    divided.trainer = SimpleNamespace(global_rank=0, world_size=2)
    with pytest.raises(UserError, match="12 training images for processes with batches of 8"):
        divided.train_dataloader()
    divided.trainer.world_size = 6
    with pytest.raises(UserError, match="5 validation images for more processes"):
        divided.val_dataloader()
    with pytest.raises(ValueError, match="masking requires backgrounds"):
        build(backgrounds=None)
    assert build(masking=None, augment=None, backgrounds=None).train_item(0, 0).size == (64, 64)


def test_collate_pads_instances(fake_source):
    first, none, two = (fake_source().sample(index) for index in range(3))
    none.instances = []
    two.instances.append(replace(two.instances[0], label="can"))
    batch = collate([first, none, two], {"can": 0, "box": 1})
    assert batch.object_index.tolist() == [[1, PADDING], [PADDING] * 2, [1, 0]]
    assert (batch.images.dtype, batch.images.shape) == (torch.uint8, (3, 3, 48, 64))
    assert batch.images.is_contiguous(memory_format=torch.channels_last)
    np.testing.assert_array_equal(batch.images[2].permute(1, 2, 0).numpy(), two.image)
    for stored, given in (
        (batch.K[0], first.K),
        (batch.T_cam_obj[2, 1], two.instances[1].T_cam_obj),
        (batch.keypoints[0, 0], first.instances[0].keypoints),
    ):
        np.testing.assert_allclose(stored.numpy(), given, rtol=1e-6)
    padding = batch.object_index == PADDING
    assert batch.keypoints[padding].isnan().all()
    assert not batch.keypoints[~padding].isnan().any()
    assert (batch.T_cam_obj[padding] == torch.eye(4)).all()
    assert batch.visible_fraction[padding].eq(0).all()
    assert (batch.keys, batch.sources) == (["0/0", "0/1", "0/2"], ["fake"] * 3)
    assert len(batch) == 3


def test_a_batch_without_instances_keeps_one_padding_slot(fake_source):
    sample = fake_source().sample(0)
    sample.instances = []
    assert collate([sample, sample], {"box": 0}).object_index.tolist() == [[PADDING], [PADDING]]
