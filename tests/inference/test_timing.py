"""Where the time of a frame goes, of an estimator whose steps take a known time."""

from __future__ import annotations

import time

import numpy as np
import pytest

from dopepp.geometry.camera import camera_matrix
from dopepp.inference.benchmark import WARM_UP, time_frames
from dopepp.inference.estimator import PoseEstimator
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.network import build_network
from dopepp.parts.catalogue import pivconnector


class Slow:
    """A runtime whose first answer takes longer than the others."""

    def __init__(self, network):
        self.network, self.stride, self.size_multiple = network, 8, 32
        self.calls = 0

    def maps(self, images):
        self.calls += 1
        time.sleep(0.2 if self.calls == 1 else 0.05)
        return self.network.maps(images)


def test_the_first_frame_and_the_networks_share(tiny_spec):
    network = build_network(tiny_spec).eval()
    checkpoint = Checkpoint(
        tiny_spec, network.state_dict(), [pivconnector()], (64, 64), 8, 1.0,
        {"centroid_threshold": 1.0},
    )  # fmt: skip
    estimator = PoseEstimator(Slow(network), checkpoint)
    pictures = [(np.zeros((64, 64, 3), np.uint8), camera_matrix(64, 64, 31.5, 31.5))] * 2
    timing = time_frames(estimator, pictures, 4)
    assert estimator.network.calls == 1 + WARM_UP + 4
    assert timing.first >= 200
    assert (timing.steps["network"] >= 50).all()
    assert timing.steps["network"].max() < timing.first
    assert (timing.steps["refine"], timing.frame.shape) == (pytest.approx(0), (4,))
    assert (sum(timing.steps.values()) <= timing.frame).all()
    assert timing.num_found == 0
