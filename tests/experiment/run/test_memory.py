"""The tuning cache: images and maps are computed once and equal a new computation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dopepp.data.sample import Instance, Sample
from dopepp.experiment.run.tuning import TuningCache
from dopepp.geometry.camera import camera_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.network import build_network
from dopepp.parts import load_part

K = camera_matrix(100, 100, 31.5, 31.5)


class Noise:
    """Images of noise that record their requests."""

    name = "noise"

    def __init__(self) -> None:
        self.requests: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return 3

    def sample(self, index: int, epoch: int = 0) -> Sample:
        self.requests.append((index, epoch))
        image = np.random.default_rng([index, epoch]).integers(0, 256, (64, 64, 3), np.uint8)
        mask = np.zeros((64, 64), bool)
        return Sample(image, K, [Instance("servoholder", np.eye(4), np.zeros((9, 2)), mask=mask)])


def test_items_of_a_source_are_cached_up_to_the_limit():
    source, other = Noise(), Noise()
    cache = TuningCache(max_bytes=2 * 64 * 64 * 4)  # of two images with their masks
    cached, other_cached = cache.of(source), cache.of(other)
    assert len(cached) == 3
    for _ in range(2):
        for index in range(3):
            assert (cached.sample(index).image == source.sample(index).image).all()
    assert [source.requests.count((index, 0)) for index in range(3)] == [3, 3, 4]
    cached.sample(0, epoch=1)
    assert (0, 1) in source.requests
    other_cached.sample(0)
    assert other.requests == [(0, 0)]  # items of other sources are separate


@pytest.mark.parametrize(("most", "length"), [(1, 1), (2, 2), (3, 3), (9, 3)])
def test_a_source_ends_when_it_has_enough_instances(most, length):
    source = Noise()
    cached = TuningCache().of(source, most)
    assert len(cached) == length
    assert source.requests == [(index, 0) for index in range(length)]


def test_a_network_runs_once_per_image(tiny_spec):
    torch.manual_seed(0)
    network = build_network(tiny_spec)
    part = load_part("servoholder")
    checkpoint = Checkpoint(tiny_spec, network.state_dict(), [part], (64, 64), 8, 1.0, {})
    estimator = PoseEstimator(network, checkpoint)
    passes: list[int] = []
    estimator.network.register_forward_hook(lambda *_: passes.append(1))
    cached = TuningCache().with_cached_maps(estimator)
    first, second = (Noise().sample(index).image for index in range(2))
    for image in (first, second, first, first[::-1].copy(), second):
        for left, same in zip(cached.maps(image), estimator.maps(image), strict=True):
            torch.testing.assert_close(left, same, rtol=0, atol=0)
    assert len(passes) == 5 + 3
    cached.recovery = None  # the original estimator is unchanged
    assert estimator.recovery is not None
