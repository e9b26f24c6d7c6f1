"""Distances of poses against brute force, scipy, OpenCV and closed forms."""

import math
import re

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from dopepp.metrics.functional import (
    add,
    add_s,
    reprojection_error,
    rotation_error_deg,
    translation_error,
)

Array = NDArray[np.float64]
REL = 1e-9
K = torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])


def poses(n: int, seed: int, near: bool = False) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    R_gt = Rotation.random(n, random_state=rng)
    turn = Rotation.from_rotvec(rng.normal(0, 0.05, (n, 3)))
    R_est = R_gt * turn if near else Rotation.random(n, random_state=rng)
    t_gt = rng.normal([0, 0, 1], 0.1, (n, 3))
    t_est = t_gt + rng.normal(0, 0.01, (n, 3))
    arrays = (R_est.as_matrix(), t_est, R_gt.as_matrix(), t_gt)
    return tuple(torch.from_numpy(a) for a in arrays)  # type: ignore[return-value]


def cloud(n: int, seed: int = 0) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.uniform(-0.05, 0.05, (n, 3)) * [1, 0.7, 0.1])


def placed(R: Tensor, t: Tensor, points: Tensor) -> Array:
    return np.array(
        [
            [R_i @ p + t_i for p in points.numpy()]
            for R_i, t_i in zip(R.numpy(), t.numpy(), strict=True)
        ]
    )


@pytest.mark.parametrize("near", [False, True])
def test_add_equals_the_loop(near):
    R_est, t_est, R_gt, t_gt = poses(7, 1, near)
    points = cloud(50)
    difference = placed(R_est, t_est, points) - placed(R_gt, t_gt, points)
    expected = np.sqrt((difference**2).sum(-1)).mean(-1)
    np.testing.assert_allclose(add(R_est, t_est, R_gt, t_gt, points), expected, rtol=REL)


def test_add_s_runs_from_true_points_to_estimated_ones():
    # Points 0 and 1 on a line, the estimate shrunk to one end: true point 1 is 1 away from it,
    # while seen from the estimate every point would lie on a true one.
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]], dtype=torch.float64)
    eye, zero = torch.eye(3).double()[None], torch.zeros(1, 3).double()
    assert add_s(0 * eye, zero, eye, zero, points).item() == pytest.approx(0.5, rel=REL)


def test_chunks_change_nothing(monkeypatch):
    pose, points = poses(9, 4), cloud(64)
    whole = add(*pose, points), add_s(*pose, points), reprojection_error(*pose, points, K)
    monkeypatch.setattr("dopepp.metrics.functional.distances._CHUNK_POINTS", 128)
    parts = add(*pose, points), add_s(*pose, points), reprojection_error(*pose, points, K)
    for a, b in zip(whole, parts, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=0)


@given(
    arrays(np.float64, 3, elements=st.floats(-1, 1)),
    arrays(np.float64, 3, elements=st.floats(-4, 4)),
)
@settings(deadline=None, max_examples=40)
def test_a_pure_translation_is_its_own_length(shift, rotvec):
    R = torch.from_numpy(Rotation.from_rotvec(rotvec).as_matrix())[None]
    t = torch.tensor([[0.1, -0.2, 0.9]], dtype=torch.float64)
    moved = t + torch.from_numpy(shift)
    length = pytest.approx(float(np.linalg.norm(shift)), rel=REL, abs=1e-15)
    assert add(R, moved, R, t, cloud(20)).item() == length
    assert translation_error(moved, t).item() == length
    assert add_s(R, moved, R, t, cloud(20)).item() <= add(R, moved, R, t, cloud(20)).item() + 1e-15


def test_reprojection_error_equals_opencv():
    R_est, t_est, R_gt, t_gt = poses(5, 6)
    points = cloud(40)
    camera = np.array([[1066.778, 0, 312.9869], [0, 1067.487, 241.3109], [0, 0, 1]])

    def pixels(R: Tensor, t: Tensor) -> Array:
        rvec = cv2.Rodrigues(R.numpy())[0]
        return np.asarray(cv2.projectPoints(points.numpy(), rvec, t.numpy(), camera, None)[0])[:, 0]

    expected = [
        np.linalg.norm(pixels(R_est[i], t_est[i]) - pixels(R_gt[i], t_gt[i]), axis=1).mean()
        for i in range(5)
    ]
    result = reprojection_error(R_est, t_est, R_gt, t_gt, points, torch.from_numpy(camera))
    np.testing.assert_allclose(result, expected, rtol=REL)
    each = torch.from_numpy(np.tile(camera, (5, 1, 1)))
    torch.testing.assert_close(reprojection_error(R_est, t_est, R_gt, t_gt, points, each), result)


def test_a_point_behind_the_camera_makes_the_reprojection_infinite():
    R, t, _, _ = poses(2, 7)
    behind = t * torch.tensor([[1.0, 1, 1], [1, 1, -1]])
    errors = reprojection_error(R, behind, R, t, cloud(5), K)
    assert errors[0] == 0
    assert errors[1] == math.inf


@example(math.radians(1e-6), np.array([0.0, 1, 0]), 0)
@example(math.pi, np.array([0.0, 1, 0]), 0)
@given(st.floats(0, math.pi), arrays(np.float64, 3, elements=st.floats(-1, 1)), st.integers(0, 99))
@settings(deadline=None, max_examples=60)
def test_rotation_error_equals_scipy(angle, axis, seed):
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-3 else np.array([1.0, 0, 0])
    base = Rotation.random(random_state=seed)
    turned = Rotation.from_rotvec(angle * axis) * base
    error = rotation_error_deg(
        torch.from_numpy(turned.as_matrix())[None], torch.from_numpy(base.as_matrix())[None]
    ).item()
    # 1e-13 degrees is the rounding of the matrices themselves.
    magnitude = np.degrees((turned * base.inv()).magnitude())
    assert error == pytest.approx(magnitude, rel=REL, abs=1e-13)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", range(4))
def test_a_pose_that_is_not_finite_is_a_miss(bad, which):
    pose = [tensor.clone() for tensor in poses(3, 8)]
    pose[which][1] = bad
    for errors in (
        add(*pose, cloud(10)),
        add_s(*pose, cloud(10)),
        reprojection_error(*pose, cloud(10), K),
    ):
        assert errors[1] == math.inf
        assert errors[[0, 2]].isfinite().all()
    single = rotation_error_deg(pose[0], pose[2]), translation_error(pose[1], pose[3])
    assert single[which % 2][1] == math.inf


def test_no_poses_have_no_errors():
    none = torch.empty(0, 3, 3), torch.empty(0, 3), torch.empty(0, 3, 3), torch.empty(0, 3)
    K = torch.eye(3)
    for errors in (
        add(*none, cloud(5)),
        add_s(*none, cloud(5)),
        reprojection_error(*none, cloud(5), K),
        rotation_error_deg(none[0], none[2]),
        translation_error(none[1], none[3]),
    ):
        assert errors.shape == (0,)


@pytest.mark.parametrize(
    ("pose", "points", "message"),
    [
        (tuple(x[0] for x in poses(1, 0)), cloud(3), "poses must be (N, 3, 3), (N, 3)"),
        ((*poses(2, 0)[:3], poses(1, 0)[3]), cloud(3), "poses must be (N, 3, 3), (N, 3)"),
        (poses(1, 0), torch.empty(0, 3), "points must be (V, 3) with V >= 1"),
        (poses(1, 0), cloud(3)[0], "points must be (V, 3) with V >= 1"),
    ],
)
def test_wrong_shapes_are_refused(pose, points, message):
    for error in (add, add_s):
        with pytest.raises(ValueError, match=re.escape(message)):
            error(*pose, points)
    with pytest.raises(ValueError, match=r"K must be \(3, 3\) or \(N, 3, 3\)"):
        reprojection_error(*poses(3, 0), cloud(3), torch.eye(3).expand(2, 3, 3))


def test_single_precision_inputs_are_computed_in_double():
    pose = poses(3, 9)
    rounded = [tensor.float() for tensor in pose]
    result = add(*rounded, cloud(10).float())
    assert result.dtype == torch.float64
    expected = add(*(t.double() for t in rounded), cloud(10).float().double())
    assert torch.equal(result, expected)
