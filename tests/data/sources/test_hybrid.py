import logging
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.data.hybrid import VIRTUAL, HybridSource, WindowedSource
from dopepp.data.rendered import RenderedSource
from dopepp.data.sample import Sample, crop_sample, letterbox_sample
from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory
from tests.data.makers import MadeSource


def named(name: str, num_items: int) -> MadeSource:
    """Return a source whose samples carry (epoch, index) in their key."""

    def make(index: int, epoch: int) -> Sample:
        image = np.zeros((2, 2, 3), np.uint8)
        return Sample(image, np.eye(3), source=name, key=f"{epoch}/{index}")

    return MadeSource(make, num_items, name)


def items(source: HybridSource, epoch: int) -> list[tuple[str, str]]:
    samples = [source.sample(i, epoch) for i in range(len(source))]
    return [(sample.source, sample.key) for sample in samples]


@given(
    real=st.builds(named, st.just("real"), st.integers(1, 12)),
    virtual=st.builds(named, st.just("virtual"), st.integers(1, 40)),
    synthetic=st.none() | st.builds(named, st.just("synthetic"), st.integers(1, 9)),
    fractions=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    length=st.integers(1, 40),
    seed=st.integers(0, 1000),
)
def test_shares_are_exact_and_items_used_equally(real, virtual, synthetic, fractions, length, seed):
    fraction, synthetic_fraction = fractions
    mix = HybridSource(real, virtual, fraction, length, seed, synthetic, synthetic_fraction)
    used = Counter()
    for epoch in range(3):
        epoch_items = items(mix, epoch)
        counts = Counter(name for name, _ in epoch_items)
        assert counts["real"] == round(fraction * length)
        expected = 0 if synthetic is None else synthetic_fraction * (length - counts["real"])
        assert abs(counts["synthetic"] - expected) <= 0.5
        assert (counts["real"], counts["virtual"], counts["synthetic"]) == mix.counts
        used.update((name, key.partition("/")[2]) for name, key in epoch_items)
        # No (epoch, index) of a source is repeated, so no background or render is.
        assert len(set(epoch_items)) == length
    for source in (real, virtual):
        uses = [used[source.name, str(i)] for i in range(len(source))]
        assert max(uses) - min(uses) <= 1


def test_pure_function_of_seed_epoch_and_index():
    def build(seed):
        return HybridSource(named("real", 7), named("virtual", 30), 0.5, 20, seed)

    forward = [items(build(3), epoch) for epoch in range(4)]
    fresh = build(3)
    for epoch in (3, 1, 2, 0):
        for index in reversed(range(20)):
            sample = fresh.sample(index, epoch)
            assert (sample.source, sample.key) == forward[epoch][index]
    assert forward[0] != forward[1]
    assert items(build(4), 0) != forward[0]
    # The order is mixed, not real frames first.
    names = [name for name, _ in forward[0]]
    assert names != sorted(names)


def test_a_missing_source_gives_its_share_to_the_others(caplog):
    def counts(*sources):
        return HybridSource(*sources[:2], 0.3, 10, 0, *sources[2:]).counts

    assert counts(None, named("virtual", 5)) == (0, 10, 0)
    assert counts(named("real", 5), None, named("synthetic", 5), 0.2) == (3, 0, 7)
    real, synthetic = named("real", 5), named("synthetic", 5)
    assert HybridSource(real, None, 0.5, 5, 0, synthetic).counts == (2, 0, 3)
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        assert counts(named("real", 5), None) == (10, 0, 0)
    assert "the real share is 1" in caplog.text


def test_contains_and_describe_ignore_unused_sources():
    mix = HybridSource(named("real", 5), named("virtual", 5), 0.0, 10, 0)
    assert (mix.contains("real"), mix.contains("virtual")) == (False, True)
    (info,) = mix.describe()
    assert info.name == "virtual"
    shares = {"seed": 0, "samples_per_epoch": 10, "role": "virtual", "count": 10}
    assert info.identity["hybrid"] == shares
    assert {mix.locate(i, 0)[0] for i in range(10)} == {VIRTUAL}


PART = pivconnector()


@pytest.fixture(scope="module")
def frames():
    return RenderedSource(Factory([PART], PRESETS["wide"].reframed(320, 240), 1), 4)


@pytest.fixture(scope="module")
def windows(frames):
    def make(number: int, window=(96, 64), size=(160, 120)) -> list[Sample]:
        source = WindowedSource(frames, size, window, 5)
        return [source.sample(index % 4, index // 4) for index in range(number)]

    return make


def test_keypoints_follow_the_window(windows):
    for sample in windows(8):
        assert sample.size == (96, 64)
        for detection in sample.instances:
            expected = project_keypoints(PART.cuboid, detection.T_cam_obj, sample.K)
            np.testing.assert_allclose(detection.keypoints, expected, atol=1e-6)
            assert detection.mask.shape == (64, 96)


def test_a_window_is_a_crop_of_the_resized_image(frames):
    whole = letterbox_sample(frames.sample(2), (160, 120))
    window = WindowedSource(frames, (160, 120), (96, 64), 5).sample(2)
    left, top = np.round(whole.K[:2, 2] - window.K[:2, 2]).astype(int)
    region = np.s_[top : top + 64, left : left + 96]
    np.testing.assert_array_equal(window.image, whole.image[region])
    np.testing.assert_array_equal(window.instances[0].mask, whole.instances[0].mask[region])


def test_every_window_contains_a_centre_at_a_random_position(windows):
    shown = windows(40)
    centres = np.array([sample.instances[0].keypoints[CENTROID] for sample in shown])
    assert ((centres > -0.5) & (centres < (95.5, 63.5))).all()
    assert (centres.std(axis=0) > 8).all()
    places = {tuple(sample.K[:2, 2]) for sample in shown}
    assert len(places) > 35
    for first, other in zip(shown, windows(8), strict=False):
        np.testing.assert_array_equal(first.image, other.image)


def test_an_image_smaller_than_the_window_is_padded(windows):
    (sample,) = windows(1, window=(200, 64))
    assert (sample.size, sample.instances[0].mask.shape) == ((200, 64), (64, 200))
    assert not sample.image[:, 160:].any()
    assert sample.image[:, :160].any(axis=(0, 2)).all()


def test_without_an_object_a_window_is_anywhere():
    class Empty:
        name = "empty"

        def sample(self, index, epoch=0):
            return Sample(np.arange(160 * 120 * 3).astype(np.uint8).reshape(120, 160, 3), np.eye(3))

    source = WindowedSource(Empty(), (160, 120), (32, 32), 0)
    corners = -np.array([source.sample(0, epoch).K[:2, 2] for epoch in range(400)])
    assert (corners.min(axis=0) < 8).all()
    assert (corners.max(axis=0) > (120, 80)).all()
    assert (corners.max(axis=0) <= (128, 88)).all()


@pytest.mark.parametrize("has_mask", [True, False])
def test_pixels_outside_the_window_are_not_visible(has_mask, frames):
    def fraction(left, width):
        return crop_sample(sample, left, 0, (width, 240)).instances[0].visible_fraction

    sample = frames.sample(0)
    (instance,) = sample.instances
    middle = int(np.flatnonzero(instance.mask.any(axis=0)).mean())
    if not has_mask:
        instance.mask = None
    fractions = [fraction(0, middle), fraction(middle, 320 - middle)]
    assert sum(fractions) == pytest.approx(instance.visible_fraction, abs=1e-3)
    assert min(fractions) > 0.1
    assert crop_sample(sample, 0, 0, (2, 2)).instances[0].visible_fraction == 0


def test_no_count_is_negative():
    sources = [named(name, 3) for name in ("real", "virtual", "synthetic")]
    real, virtual, synthetic = sources
    assert HybridSource(real, virtual, 0.5, 10003, 0, synthetic, 1.0).counts == (5002, 0, 5001)
