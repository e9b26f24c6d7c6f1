"""Time per frame with known delays; agreement of two estimators with known maps and detections."""

import math
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dopepp.geometry.camera import camera_matrix, make_transform
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.benchmark import WARM_UP, compare_export, time_frames
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.network import build_network
from dopepp.parts.catalogue import pivconnector

K = camera_matrix(130, 130, 63.5, 47.5)
IMAGE = np.zeros((96, 128, 3), np.uint8)


def pose(x=0.0, z=0.3, degrees=0.0, name="pivconnector"):
    R = rotation_vector_to_matrix(np.array([0.0, math.radians(degrees), 0.0]))
    return SimpleNamespace(object=name, T_cam_obj=make_transform(R, np.array([x, 0.0, z])))


class ConstantEstimator:
    """An estimator with constant detections and maps."""

    def __init__(self, detections, belief=0.5):
        self.detections, self.belief = detections, belief
        self.network = SimpleNamespace(size_multiple=32)
        self.checkpoint = Checkpoint({}, {}, [pivconnector()], (128, 96), 8, 1.0)

    def predict(self, image, K, cropped):
        return self.detections

    def maps(self, pixels):
        return torch.full((9, 4, 4), self.belief), torch.zeros(16, 4, 4)


def compare(exported, original=None, belief=0.5):
    estimators = ConstantEstimator(exported, belief), ConstantEstimator(original or [pose()])
    return compare_export(*estimators, [(IMAGE, K)] * 2)


@pytest.mark.parametrize(
    ("exported", "mm", "degrees", "is_exact"),
    [
        ([pose()], 0.0, 0.0, True),
        ([pose(x=0.00005, degrees=0.04)], 0.05, 0.04, True),
        ([pose(x=0.0002)], 0.2, 0.0, False),
        ([pose(degrees=0.06)], 0.0, 0.06, False),
    ],
)
def test_differences_of_poses(exported, mm, degrees, is_exact):
    agreement = compare(exported)
    assert agreement.position_mm == pytest.approx(mm, abs=1e-9)
    assert agreement.rotation_deg == pytest.approx(degrees, abs=1e-6)
    assert (agreement.num_poses, agreement.num_single, agreement.num_images) == (2, 0, 2)
    assert agreement.is_exact == is_exact


def test_best_pose_of_each_object_is_compared():
    original = [pose(x=0.0), pose(x=0.1), pose(x=0.1, name="servoholder")]
    exported = [pose(x=0.00003), pose(x=0.5, degrees=120)]
    agreement = compare(exported, original)
    assert agreement.position_mm == pytest.approx(0.03)
    assert (agreement.num_poses, agreement.num_single) == (2, 2)
    assert not agreement.is_exact
    assert "2 detected by one network only" in str(agreement)


@pytest.mark.parametrize(("value", "is_exact"), [(0.50005, True), (0.5002, False)])
def test_differences_of_maps(value, is_exact):
    agreement = compare([pose()], belief=value)
    assert agreement.maps == pytest.approx(value - 0.5, rel=1e-2)
    assert agreement.is_exact == is_exact


def test_maps_with_nan_and_images_without_poses():
    agreement = compare_export(ConstantEstimator([], math.nan), ConstantEstimator([]), [(IMAGE, K)])
    assert agreement.maps == math.inf
    assert not agreement.is_exact
    assert "no pose detected by both" in str(agreement)


class Slow:
    """A runtime whose first call takes longer than later calls."""

    def __init__(self, network):
        self.network, self.stride, self.size_multiple = network, 8, 32
        self.calls = 0

    def maps(self, images):
        self.calls += 1
        time.sleep(0.2 if self.calls == 1 else 0.05)
        return self.network.maps(images)


def test_timing_of_first_frame_and_steps(tiny_spec):
    network = build_network(tiny_spec).eval()
    rest = [pivconnector()], (64, 64), 8, 1.0, {"centroid_threshold": 1.0}
    estimator = NetworkEstimator(Slow(network), Checkpoint(tiny_spec, network.state_dict(), *rest))
    images = [(np.zeros((64, 64, 3), np.uint8), camera_matrix(64, 64, 31.5, 31.5))] * 2
    timing = time_frames(estimator, images, 4)
    assert estimator.network.calls == 1 + WARM_UP + 4
    assert timing.first >= 200
    assert (timing.steps["network"] >= 50).all()
    assert timing.steps["network"].max() < timing.first
    assert (timing.steps["refine"], timing.frame.shape) == (pytest.approx(0), (4,))
    assert (sum(timing.steps.values()) <= timing.frame).all()
    assert timing.num_found == 0
