"""What the comparison of two estimators says, on detections and maps that are known."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from dopepp.geometry.camera import camera_matrix, make_transform
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.benchmark import compare_export
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.catalogue import pivconnector

K = camera_matrix(130, 130, 63.5, 47.5)
IMAGE = np.zeros((96, 128, 3), np.uint8)


def pose(x=0.0, z=0.3, degrees=0.0, name="pivconnector"):
    R = rotation_vector_to_matrix(np.array([0.0, math.radians(degrees), 0.0]))
    return SimpleNamespace(object=name, T_cam_obj=make_transform(R, np.array([x, 0.0, z])))


@dataclass
class Answer:
    """Stands in for an estimator that always answers the same."""

    found: list[Any]
    maps_of: float = 0.5
    network: Any = field(default_factory=lambda: SimpleNamespace(size_multiple=32))
    checkpoint: Any = field(
        default_factory=lambda: Checkpoint({}, {}, [pivconnector()], (128, 96), 8, 1.0)
    )

    def predict(self, image, K, cropped):
        return self.found

    def maps(self, pixels):
        return torch.full((9, 4, 4), self.maps_of), torch.zeros(16, 4, 4)


def compared(theirs, ours=None, maps_of=0.5):
    return compare_export(Answer(theirs, maps_of), Answer(ours or [pose()]), [(IMAGE, K)] * 2)


@pytest.mark.parametrize(
    ("theirs", "mm", "degrees", "is_exact"),
    [
        ([pose()], 0.0, 0.0, True),
        ([pose(x=0.00005, degrees=0.04)], 0.05, 0.04, True),
        ([pose(x=0.0002)], 0.2, 0.0, False),
        ([pose(degrees=0.06)], 0.0, 0.06, False),
    ],
)
def test_poses(theirs, mm, degrees, is_exact):
    agreement = compared(theirs)
    assert agreement.position_mm == pytest.approx(mm, abs=1e-9)
    assert agreement.rotation_deg == pytest.approx(degrees, abs=1e-6)
    assert (agreement.num_poses, agreement.num_single, agreement.num_pictures) == (2, 0, 2)
    assert agreement.is_exact == is_exact


def test_the_best_of_each_object_are_compared_and_the_rest_are_counted():
    """What else is seen of an object may lie on the brink of two poses."""
    ours = [pose(x=0.0), pose(x=0.1), pose(x=0.1, name="servoholder")]
    theirs = [pose(x=0.00003), pose(x=0.5, degrees=120)]
    agreement = compared(theirs, ours)
    assert agreement.position_mm == pytest.approx(0.03)
    assert (agreement.num_poses, agreement.num_single) == (2, 2)
    assert not agreement.is_exact
    assert "2 found by one alone" in str(agreement)


@pytest.mark.parametrize(("value", "is_exact"), [(0.50005, True), (0.5002, False)])
def test_maps(value, is_exact):
    agreement = compared([pose()], maps_of=value)
    assert agreement.maps == pytest.approx(value - 0.5, rel=1e-2)
    assert agreement.is_exact == is_exact


def test_maps_that_are_not_numbers_and_no_poses():
    agreement = compare_export(Answer([], math.nan), Answer([]), [(IMAGE, K)])
    assert agreement.maps == math.inf
    assert not agreement.is_exact
    assert "no pose found by both" in str(agreement)
