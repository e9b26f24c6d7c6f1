import errno
import multiprocessing
import os

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data.rendered import FIRST_INDEX, MAX_ITEMS, CachedSource, RenderedSource
from dopepp.data.sample import resize_sample
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS
from tests.data import makers


@pytest.fixture(scope="module")
def factory():
    return Factory([servoholder()], PRESETS["quickstart"], seed=3)


def test_sample_agrees_with_the_scene(factory):
    sample = RenderedSource(factory, 4).sample(2, epoch=1)
    rendered = factory.render(1, 2)
    np.testing.assert_array_equal(sample.image, rendered.image)
    ((target,), (instance,)) = rendered.scene.targets, sample.instances
    T = rendered.scene.objects[target].T_cam_obj
    expected, _ = cv2.projectPoints(servoholder().cuboid, T[:3, :3], T[:3, 3], sample.K, None)
    np.testing.assert_allclose(instance.keypoints, expected[:, 0], atol=1e-6)
    assert instance.visible_fraction == rendered.visible_fractions[target]
    # The visible pixels lie inside the hull of the cuboid's corners.
    hull = cv2.convexHull(instance.keypoints[:8].astype(np.float32))
    for pixel in np.argwhere(instance.mask)[:, ::-1].astype(float):
        assert cv2.pointPolygonTest(hull, tuple(pixel), True) > -1.0
    assert (sample.source, sample.key) == ("virtual", "train/1/2")


def test_splits_are_disjoint_and_only_training_has_epochs(factory):
    sources = {split: RenderedSource(factory, 3, split) for split in FIRST_INDEX}
    train, val, test = (
        [sources[split].sample(0, epoch).image for epoch in (0, 1)]
        for split in ("train", "val", "test")
    )
    for same in (val, test):
        np.testing.assert_array_equal(*same)
    for first, second in ((train[0], train[1]), (val[0], train[0]), (test[0], train[0]),
                          (val[0], test[0])):  # fmt: skip
        assert (first != second).any()
    assert min(np.diff(sorted(FIRST_INDEX.values()))) >= MAX_ITEMS


def test_bounds_description_and_objects(factory):
    source = RenderedSource(factory, 3)
    with pytest.raises(IndexError, match="index 3 is out of range"):
        source.sample(3)
    contained = [source.contains(part().name) for part in (servoholder, pivconnector)]
    assert contained == [True, False]
    (info,) = source.describe()
    assert info.identity["parts"] == {servoholder().name: servoholder().mesh_hash}
    (other,) = RenderedSource(Factory(factory.parts, factory.preset, 4), 3).describe()
    assert other.identity != info.identity


def test_a_scale_moves_the_camera_of_the_same_test_set(factory):
    usual, near = (RenderedSource(factory, 2, "test", scale=scale) for scale in (1.0, 0.5))
    first, other = usual.sample(1), near.sample(1)
    assert first.key == other.key
    np.testing.assert_allclose(other.instances[0].keypoints[8], first.instances[0].keypoints[8])
    assert (first.image != other.image).any()
    ((described,), (there,)) = usual.describe(), near.describe()
    # Caches and checkpoints of the usual images stay valid.
    assert there.identity == {**described.identity, "scale": 0.5}


def assert_same(first, second):
    makers.assert_same(first, second)
    assert (first.source, first.key) == (second.source, second.key)


def test_samples_are_rendered_once_and_cached_completely(fake_source):
    source = fake_source(num_items=3)
    cached = CachedSource(source, (64, 64))
    for epoch in (0, 5, 2):
        for index in range(3):
            assert_same(cached.sample(index, epoch), fake_source().sample(index, 0))
    assert source.calls == [(0, 0), (0, 1), (0, 2)]


def test_samples_without_mask_or_instance_are_cached_and_copied(fake_source):
    source = fake_source(num_items=2)
    bare, empty = source.sample(1), source.sample(0)
    bare.instances[0].mask, empty.instances = None, []
    source.sample = lambda index, epoch=0: (empty, bare)[index]
    cached = CachedSource(source, (64, 64))
    for _ in range(2):
        for index, expected in enumerate((empty, bare)):
            sample = cached.sample(index)
            assert_same(sample, expected)
            for array in (sample.image, sample.K, *(i.keypoints for i in sample.instances)):
                array[:] = 0


def test_images_are_cached_at_the_input_size(fake_source):
    cached = CachedSource(fake_source(size=(640, 480)), (64, 64))
    expected = resize_sample(fake_source(size=(640, 480)).sample(1), (64, 64))
    assert_same(cached.sample(1), expected)
    assert cached.num_bytes < 12 * (64 * 64 * 4 + 24_000)  # pixels, and poses of 40 instances


def test_forked_processes_fill_one_cache(fake_source):
    source = fake_source(num_items=8)
    cached = CachedSource(source, (64, 64))
    context = multiprocessing.get_context("fork")

    def fill(indices):
        for index in indices:
            cached.sample(index)

    # Overlapping ranges: two processes write the same bytes into the same slots.
    ranges = ([1, 2, 3, 4, 5], [5, 4, 3, 6, 7])
    children = [context.Process(target=fill, args=(part,)) for part in ranges]
    for child in children:
        child.start()
    for child in children:
        child.join()
        assert child.exitcode == 0
    for index in range(8):
        assert_same(cached.sample(index), fake_source().sample(index))
    assert source.calls == [(0, 0)]  # this process rendered the first item only


def test_samples_that_do_not_fit_are_rejected(fake_source, tmp_path):
    with pytest.raises(UserError, match=r"data\.cache=memory.*set data\.cache=none"):
        CachedSource(fake_source(num_items=10**9), (64, 64))
    fix = "set data.cache=none"
    with pytest.raises(
        UserError, match=f"at most 40 instances, and names of 64 letters; fix: {fix}"
    ):
        CachedSource(fake_source(label="x" * 65), (64, 64))
    for change in ({"size": (48, 64)}, {"name": "another"}):
        source = fake_source()
        cached = CachedSource(source, (64, 64))
        vars(source).update(change)
        with pytest.raises(UserError, match=rf"data\.cache=memory .*one size and source.*{fix}"):
            cached.sample(1)
    with pytest.raises(UserError, match=r"data\.cache=disk for .* with 1 inst.* at most 0 inst"):
        CachedSource(fake_source(), (64, 64), tmp_path, max_instances=0)


def test_a_cache_file_is_reused_for_equal_content_only(fake_source, tmp_path):
    def cached(num_items=4, size=(64, 64), identity="a"):
        source = fake_source(num_items)
        return source, CachedSource(source, size, tmp_path, identity=identity)

    first, kept = cached()
    for index in range(3):
        kept.sample(index)
    assert first.calls == [(0, 0), (0, 1), (0, 2)]
    second, again = cached()
    for index in range(4):
        assert_same(again.sample(index), fake_source().sample(index))
    assert second.calls == [(0, 0), (0, 3)]  # the first tells the slot's layout
    assert again.folder == kept.folder
    for change in ({"identity": "b"}, {"num_items": 5}, {"size": (32, 32)}):
        assert cached(**change)[1].folder != kept.folder


def test_a_damaged_slot_is_filled_again(fake_source, tmp_path):
    kept = CachedSource(fake_source(num_items=4), (64, 64), tmp_path)
    kept.sample(2)
    path = kept.folder / "slots.bin"
    with path.open("r+b") as file:
        file.seek(path.stat().st_size * 2 // 4 + 100)
        file.write(b"torn")
    source = fake_source(num_items=4)
    assert_same(CachedSource(source, (64, 64), tmp_path).sample(2), fake_source().sample(2))
    assert (0, 2) in source.calls


def test_a_cache_of_native_size_keeps_depth(fake_source, tmp_path):
    source = fake_source()
    sample = source.sample(1)
    sample.depth = np.linspace(0, 1, 48 * 64, dtype=np.float32).reshape(48, 64)
    source.sample = lambda index, epoch=0: sample
    kept = CachedSource(source, None, tmp_path).sample(1)
    np.testing.assert_array_equal(kept.depth, sample.depth)
    assert CachedSource(source, (64, 64)).sample(1).depth is None


def test_a_full_disk_gives_one_line(fake_source, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(UserError, match=r"data\.cache=disk.*No space left.*data\.cache_dir"):
        CachedSource(fake_source(), (64, 64), tmp_path)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_the_description_is_marked_as_cached(fake_source):
    source = fake_source()
    (info,), (plain,) = CachedSource(source, (64, 64)).describe(), source.describe()
    assert info.identity == {**plain.identity, "cached": True}
    assert CachedSource(source, (64, 64)).contains("box")
