import logging
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopepp.core.errors import UserError
from dopepp.data.hybrid import VIRTUAL, HybridSource
from dopepp.data.sample import Sample, SourceInfo


class Named:
    """A source whose samples carry (epoch, index) in their key."""

    def __init__(self, name: str, num_items: int) -> None:
        self.name, self._num_items = name, num_items

    def __len__(self) -> int:
        return self._num_items

    def sample(self, index: int, epoch: int = 0) -> Sample:
        assert 0 <= index < self._num_items
        image = np.zeros((2, 2, 3), np.uint8)
        return Sample(image, np.eye(3), source=self.name, key=f"{epoch}/{index}")

    def contains(self, label: str) -> bool:
        return label == self.name

    def describe(self) -> list[SourceInfo]:
        return [SourceInfo(self.name, self._num_items)]


def items(source: HybridSource, epoch: int) -> list[tuple[str, str]]:
    samples = [source.sample(i, epoch) for i in range(len(source))]
    return [(sample.source, sample.key) for sample in samples]


@settings(max_examples=50)
@given(
    real=st.builds(Named, st.just("real"), st.integers(1, 12)),
    virtual=st.builds(Named, st.just("virtual"), st.integers(1, 40)),
    synthetic=st.none() | st.builds(Named, st.just("synthetic"), st.integers(1, 9)),
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
        expected = 0 if synthetic is None else (1 - fraction) * synthetic_fraction * length
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
        return HybridSource(Named("real", 7), Named("virtual", 30), 0.5, 20, seed)

    forward = [items(build(3), epoch) for epoch in range(4)]
    fresh, backward = build(3), {}
    for epoch in (3, 1, 2, 0):
        for index in reversed(range(20)):
            sample = fresh.sample(index, epoch)
            backward[epoch, index] = (sample.source, sample.key)
    assert all(backward[e, i] == forward[e][i] for e in range(4) for i in range(20))
    assert forward[0] != forward[1]
    assert items(build(4), 0) != forward[0]
    # The order is mixed, not real frames first.
    names = [name for name, _ in forward[0]]
    assert names != sorted(names)


def test_a_missing_source_gives_its_share_to_the_others(caplog):
    assert HybridSource(None, Named("virtual", 5), 0.5, 10, 0).counts == (0, 10, 0)
    synthetic = Named("synthetic", 5)
    only_synthetic = HybridSource(Named("real", 5), None, 0.3, 10, 0, synthetic, 0.2)
    assert only_synthetic.counts == (3, 0, 7)
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        assert HybridSource(Named("real", 5), None, 0.3, 10, 0).counts == (10, 0, 0)
    assert "the real share is 1" in caplog.text


def test_contains_and_describe_ignore_unused_sources():
    mix = HybridSource(Named("real", 5), Named("virtual", 5), 0.0, 10, 0)
    assert not mix.contains("real")
    assert mix.contains("virtual")
    (info,) = mix.describe()
    assert info.name == "virtual"
    shares = {"seed": 0, "samples_per_epoch": 10, "role": "virtual", "count": 10}
    assert info.identity["hybrid"] == shares
    roles = {mix.locate(i, 0)[0] for i in range(10)}
    assert roles == {VIRTUAL}


def test_a_mix_without_a_source_is_rejected():
    with pytest.raises(UserError, match="without any source"):
        HybridSource(None, None, 0.5, 4, 0)
