import errno
import multiprocessing
import os

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data import rendered
from dopepp.data.rendered import CachedSource
from dopepp.data.sample import Sample, resize_sample


def assert_same(first: Sample, second: Sample) -> None:
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.K, second.K)
    assert (first.source, first.key) == (second.source, second.key)
    for instance, other in zip(first.instances, second.instances, strict=True):
        assert (instance.label, instance.visible_fraction) == (other.label, other.visible_fraction)
        np.testing.assert_array_equal(instance.T_cam_obj, other.T_cam_obj)
        np.testing.assert_array_equal(instance.keypoints, other.keypoints)
        assert (instance.mask is None) == (other.mask is None)
        if instance.mask is not None and other.mask is not None:
            np.testing.assert_array_equal(instance.mask, other.mask)


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
    children = [
        context.Process(target=fill, args=(part,)) for part in ([1, 2, 3, 4, 5], [5, 4, 3, 6, 7])
    ]
    for child in children:
        child.start()
    for child in children:
        child.join()
        assert child.exitcode == 0
    for index in range(8):
        assert_same(cached.sample(index), fake_source().sample(index))
    assert source.calls == [(0, 0)]  # this process rendered the first item only


def test_samples_that_do_not_fit_are_rejected(fake_source, monkeypatch):
    with pytest.raises(UserError, match=r"data\.cache=memory.*set data\.cache=none"):
        CachedSource(fake_source(num_items=10**9), (64, 64))
    with pytest.raises(ValueError, match="more than 64 characters"):
        CachedSource(fake_source(label="x" * 65), (64, 64))
    for change in ({"size": (48, 64)}, {"name": "another"}):
        source = fake_source()
        cached = CachedSource(source, (64, 64))
        vars(source).update(change)
        with pytest.raises(ValueError, match="one size and source"):
            cached.sample(1)
    monkeypatch.setattr(rendered, "_MAX_INSTANCES", 0)
    with pytest.raises(ValueError, match="1 instances; at most 0"):
        CachedSource(fake_source(), (64, 64))


def test_a_cache_file_is_reused_for_equal_content_only(fake_source, tmp_path):
    first = fake_source(num_items=4)
    kept = CachedSource(first, (64, 64), tmp_path, identity="a")
    for index in range(3):
        kept.sample(index)
    assert first.calls == [(0, 0), (0, 1), (0, 2)]

    second = fake_source(num_items=4)
    again = CachedSource(second, (64, 64), tmp_path, identity="a")
    for index in range(4):
        assert_same(again.sample(index), fake_source().sample(index))
    assert second.calls == [(0, 0), (0, 3)]  # the first tells the slot's layout
    assert again.folder == kept.folder

    for other in (
        CachedSource(fake_source(num_items=4), (64, 64), tmp_path, identity="b"),
        CachedSource(fake_source(num_items=5), (64, 64), tmp_path, identity="a"),
        CachedSource(fake_source(num_items=4), (32, 32), tmp_path, identity="a"),
    ):
        assert other.folder != kept.folder


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
