"""The decoder on arbitrary maps gives finite detections or a documented error."""

from typing import Any, Final

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from dopepp.geometry.camera import camera_matrix
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.recovery import Detection, explain, recover, recover_batch

QUICK: Final = 40
THOROUGH: Final = 6000
"""Numbers of maps, for a few seconds and for some minutes."""

VALUES: Final = (
    0.0, 1.0, -1.0, 0.02, 0.05, 0.5, 1e-30, 1e-7, 1e30, 3e38, -3e38, float("nan"), float("inf"),
    -float("inf"),
)  # fmt: skip

LENGTHS: Final = (0.05, 1e-3, 1.0, 0.0, 1e-12, 1e6, 1e-300, 1e150, float("nan"), float("inf"))
"""Half-extents of a cuboid, metres."""

FOCAL: Final = (60.0, 1.0, 1e-6, 1e6, 0.0, -60.0, 1e200, float("nan"), float("inf"))


def make_maps(case: dict[str, Any]) -> tuple[Tensor, Tensor]:
    """Make belief and field maps: noise, a constant or peaks, with odd numbers in some cells."""
    rng = np.random.default_rng(case["seed"])
    rows, columns = case["cells"]
    objects = case["objects"]
    maps = []
    for channels in (9 * objects, 16 * objects):
        shape = (channels, rows, columns)
        if case["kind"] == "constant":
            values = np.full(shape, case["value"])
        elif case["kind"] == "noise":
            values = rng.normal(0, 1, shape) * case["value"]
        else:
            values = np.zeros(shape)
            for channel in values:
                row, column = rng.integers(rows), rng.integers(columns)
                channel[row, column] = case["value"]
                channel[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] += 0.3
        odd = rng.uniform(size=shape) < case["share"]
        values[odd] = case["odd"]
        with np.errstate(over="ignore"):
            maps.append(torch.from_numpy(values.astype(np.float32)))
    return maps[0].to(case["dtype"]), maps[1].to(case["dtype"])


CASES = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**32 - 1),
        "cells": st.tuples(st.integers(1, 14), st.integers(1, 14)),
        "objects": st.integers(0, 2),
        "kind": st.sampled_from(["constant", "noise", "peaks"]),
        "value": st.sampled_from(VALUES),
        "odd": st.sampled_from(VALUES),
        "share": st.sampled_from([0.0, 0.02, 0.5]),
        "dtype": st.sampled_from([torch.float32, torch.float16, torch.bfloat16, torch.float64]),
        "half": st.tuples(*[st.sampled_from(LENGTHS)] * 3),
        "centre": st.sampled_from([0.0, 0.01, 1e3, 1e300]),
        "focal": st.sampled_from(FOCAL),
        "principal": st.sampled_from([50.0, 0.0, -1e6, 1e30, float("nan")]),
    }
)

PLAIN: Final[dict[str, Any]] = {
    "seed": 0, "cells": (12, 12), "objects": 1, "kind": "peaks", "value": 1.0, "odd": 0.0,
    "share": 0.0, "dtype": torch.float32, "half": (0.05, 0.04, 0.03), "centre": 0.0, "focal": 60.0,
    "principal": 50.0,
}  # fmt: skip


def decode(case: dict[str, Any]) -> list[Detection]:
    """Decode a case and check that the result is finite."""
    belief, field = make_maps(case)
    half = np.array(case["half"])
    with np.errstate(invalid="ignore", over="ignore"):
        cuboid = cuboid_keypoints(case["centre"] - half, case["centre"] + half)
    cuboids = np.stack([cuboid] * case["objects"]) if case["objects"] else np.zeros((0, 9, 3))
    K = camera_matrix(case["focal"], case["focal"], case["principal"], case["principal"])
    detections = recover(belief, field, cuboids, K)
    reasons = explain(belief, field, cuboids, K)
    assert all("\n" not in str(reason) for reason in reasons)
    return detections


def check(case: dict[str, Any]) -> None:
    try:
        result = decode(case)
    except ValueError:  # documented; a UserError is one, too
        if sound(case):
            raise
        return
    for detection in result:
        for value in (detection.T_cam_obj, detection.covariance, detection.reprojection_error_px):
            assert np.isfinite(value).all()
        assert 0 <= detection.score <= 1
        assert 0 <= detection.belief <= 1
        R = detection.T_cam_obj[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)


def sound(case: dict[str, Any]) -> bool:
    """Return whether camera and cuboid are valid."""
    camera = case["focal"] in (60.0, 1.0, 1e6) and case["principal"] in (50.0, 0.0)
    sides = all(length in (0.05, 1e-3, 1.0) for length in case["half"])
    return camera and sides and case["centre"] <= 1


BOX, K = cuboid_keypoints(-np.ones(3) / 20, np.ones(3) / 20)[None], camera_matrix(60, 60, 50, 50)


@settings(max_examples=QUICK, derandomize=True, database=None)
@given(CASES)
@example(PLAIN)
@example({**PLAIN, "objects": 0})  # found: a reshape of nothing
@example({**PLAIN, "focal": 1e200})  # found: a determinant beyond all numbers
def test_any_maps(case):
    check(case)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@settings(max_examples=THOROUGH, database=None, suppress_health_check=list(HealthCheck))
@given(CASES)
def test_many_maps(case):
    check(case)


WRONG: Final = {
    "nine channels too few": ((9, 4, 4), (32, 4, 4), 2, r"2 objects need \(18, 32\)"),
    "nine channels too many": ((18, 4, 4), (32, 4, 4), 1, r"1 objects need \(9, 16\)"),
    "maps of two sizes": ((9, 4, 4), (16, 4, 5), 1, r"1 objects need \(9, 16\)"),
    "no batch": ((4, 4), (16, 4, 4), 1, "maps are"),
    "no maps": ((9, 0, 4), (16, 0, 4), 1, "maps are"),
    "one dimension too many": ((1, 9, 4, 4), (1, 16, 4, 4), 1, "maps are"),
    "no objects but channels": ((9, 4, 4), (16, 4, 4), 0, "0 objects need"),
}


@pytest.mark.parametrize("name", WRONG)
def test_maps_of_other_shapes(name):
    belief, field, objects, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        recover(torch.zeros(belief), torch.zeros(field), np.repeat(BOX, objects, axis=0), K)


def test_names_and_cameras_must_be_as_many_as_objects_and_images():
    belief, field = torch.zeros(2, 9, 8, 8), torch.zeros(2, 16, 8, 8)
    with pytest.raises(ValueError, match="1 objects need as many names"):
        recover(belief[0], field[0], BOX, K, names=["a", "b"])
    with pytest.raises(ValueError, match="2 images need as many camera matrices"):
        recover_batch(belief, field, BOX, K)
