"""Distances of poses against brute force, scipy, OpenCV and closed forms."""

import math
import re

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose
from scipy.spatial import KDTree
from scipy.spatial import distance as scipy_distance
from scipy.spatial.transform import Rotation

from dopepp.geometry.symmetry import symmetry_group
from dopepp.metrics.functional import (
    add,
    add_s,
    mahalanobis,
    mspd,
    mssd,
    reprojection_error,
    rotation_error_deg,
    translation_error,
)

REL = 1e-9
K = torch.tensor([[1066.778, 0, 312.9869], [0, 1067.487, 241.3109], [0, 0, 1]]).double()
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
HALF_TURN[:2, 3] = 0.01, -0.02
IN_PIXELS = {
    "mspd": lambda *pose: mspd(*pose, K),
    "reprojection": lambda *pose: reprojection_error(*pose, K),
}
ERRORS = {"add": add, "add_s": add_s, "mssd": mssd, **IN_PIXELS}


def poses(n, seed, near=False):
    """Estimated R and t, true R and t."""
    rng = np.random.default_rng(seed)
    R_gt = Rotation.random(n, random_state=rng)
    turn = Rotation.from_rotvec(rng.normal(0, 0.05, (n, 3)))
    R_est = R_gt * turn if near else Rotation.random(n, random_state=rng)
    t_gt = rng.normal([0, 0, 1], 0.1, (n, 3))
    t_est = t_gt + rng.normal(0, 0.01, (n, 3))
    return [torch.from_numpy(item) for item in (R_est.as_matrix(), t_est, R_gt.as_matrix(), t_gt)]


def cloud(n, seed=0):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.uniform(-0.05, 0.05, (n, 3)) * [1, 0.7, 0.1])


def placed(R, t, points):
    return (points @ R.mT + t[:, None]).numpy()


@pytest.mark.parametrize("near", [False, True])
def test_add_equals_the_loop(near):
    R_est, t_est, R_gt, t_gt = poses(7, 1, near)
    points = cloud(50)
    difference = placed(R_est, t_est, points) - placed(R_gt, t_gt, points)
    expected = np.sqrt((difference**2).sum(-1)).mean(-1)
    assert_allclose(add(R_est, t_est, R_gt, t_gt, points), expected, rtol=REL)


@given(
    seed=st.integers(0, 10_000),
    count=st.sampled_from([1, 2, 7, 8, 9, 16, 17, 33, 200, 1000]),
    scale=st.floats(0.5, 2.0),
)
def test_add_s_is_exact_for_any_matrix(seed, count, scale):
    """Distances to the nearest estimated point, also for scaled, skewed and flat matrices."""
    R_est, t_est, R_gt, t_gt = poses(5, seed)
    R_est[1] *= scale
    R_est[2] += 0.3 * torch.from_numpy(np.random.default_rng(seed).normal(size=(3, 3)))
    R_est[3, :, 0] = 0.0
    R_est[4] = 0.0
    points = cloud(count, seed)
    points[count // 2 :] = points[: count - count // 2].clone()  # ties
    both = zip(placed(R_est, t_est, points), placed(R_gt, t_gt, points), strict=True)
    expected = [KDTree(estimated).query(true)[0].mean() for estimated, true in both]
    assert_allclose(add_s(R_est, t_est, R_gt, t_gt, points), expected, rtol=REL, atol=1e-15)


def test_chunks_change_nothing(monkeypatch):
    pose, points = poses(9, 4), cloud(64)
    whole = [error(*pose, points) for error in ERRORS.values()]
    monkeypatch.setattr("dopepp.metrics.functional.distances._CHUNK_POINTS", 128)
    for error, expected in zip(ERRORS.values(), whole, strict=True):
        torch.testing.assert_close(error(*pose, points), expected, rtol=1e-12, atol=0)


@given(arrays(float, 3, elements=st.floats(-1, 1)), arrays(float, 3, elements=st.floats(-4, 4)))
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

    def pixels(R, t):
        rvecs = Rotation.from_matrix(R).as_rotvec()
        each = zip(rvecs, t.numpy(), strict=True)
        return np.stack([cv2.projectPoints(points.numpy(), *T, K.numpy(), None)[0] for T in each])

    off = pixels(R_est, t_est) - pixels(R_gt, t_gt)
    expected = np.linalg.norm(off[:, :, 0], axis=-1).mean(1)
    result = reprojection_error(R_est, t_est, R_gt, t_gt, points, K)
    assert_allclose(result, expected, rtol=REL)
    each = reprojection_error(R_est, t_est, R_gt, t_gt, points, K.tile(5, 1, 1))
    torch.testing.assert_close(each, result)


@example(math.radians(1e-6), np.array([0.0, 1, 0]), 0)
@example(math.pi, np.array([0.0, 1, 0]), 0)
@given(st.floats(0, math.pi), arrays(np.float64, 3, elements=st.floats(-1, 1)), st.integers(0, 99))
def test_rotation_error_equals_scipy(angle, axis, seed):
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-3 else np.array([1.0, 0, 0])
    base = Rotation.random(random_state=seed)
    turned = Rotation.from_rotvec(angle * axis) * base
    matrices = (torch.from_numpy(item.as_matrix())[None] for item in (turned, base))
    # 1e-13 degrees is the rounding error of the matrices.
    magnitude = np.degrees((turned * base.inv()).magnitude())
    assert rotation_error_deg(*matrices).item() == pytest.approx(magnitude, rel=REL, abs=1e-13)


@given(
    seed=st.integers(0, 10_000),
    count=st.sampled_from([1, 2, 8, 9, 200]),
    turning=st.sampled_from([None, (0.0, 0.0, 1.0), (1.0, -1.0, 0.5)]),
    is_near=st.booleans(),
)
def test_mssd_and_mspd_are_their_formulas(seed, count, turning, is_near):
    """Also if most symmetries are rejected early."""
    axes = [(turning, (0.01, 0.0, 0.0))] if turning else []
    group = symmetry_group(HALF_TURN[None], axes, 0.2)
    R_est, t_est, R_gt, t_gt = (tensor.numpy() for tensor in poses(4, seed))
    if is_near:  # nearly true up to a symmetry, so that many symmetries are almost the best
        some = group[np.random.default_rng(seed).integers(len(group), size=4)]
        R_est, t_est = R_gt @ some[:, :3, :3], t_gt + (R_gt @ some[:, :3, 3:])[..., 0] + 1e-4
    t_gt[3, 2] = 0.0  # some of its points are behind the camera
    points = cloud(count, seed).numpy()
    symmetric = points @ group[:, :3, :3].transpose(0, 2, 1) + group[:, None, :3, 3]

    def pixels(points):
        projected = points @ K.numpy().T
        return projected[..., :2] / projected[..., 2:]

    surface, image = [], []
    for n in range(4):
        estimated, true = points @ R_est[n].T + t_est[n], symmetric @ R_gt[n].T + t_gt[n]
        surface.append(np.linalg.norm(estimated - true, axis=-1).max(axis=1).min())
        off = np.linalg.norm(pixels(estimated) - pixels(true), axis=-1)
        off[(true[..., 2] <= 0) | (estimated[:, 2] <= 0)] = np.inf
        image.append(off.max(axis=1).min())
    *pose, symmetries = (torch.from_numpy(x) for x in (R_est, t_est, R_gt, t_gt, points, group))
    assert_allclose(mssd(*pose, symmetries), surface, rtol=REL, atol=1e-15)
    assert_allclose(mspd(*pose, K, symmetries), image, rtol=REL, atol=1e-9)


def test_no_identity_is_added_to_the_symmetries():
    R, t = torch.eye(3).double()[None], torch.tensor([[0.0, 0.0, 1.0]])
    only_half_turn = torch.from_numpy(HALF_TURN[None])
    assert float(mssd(R, t, R, t, cloud(9), only_half_turn)[0]) > 0.01
    assert float(rotation_error_deg(R, R, only_half_turn[:, :3, :3])[0]) == pytest.approx(180)
    for wrong in (torch.eye(4), torch.zeros(0, 4, 4), torch.zeros(2, 3, 4)):
        with pytest.raises(ValueError, match="symmetries must be"):
            mssd(R, t, R, t, cloud(9), wrong)


def test_a_point_behind_the_camera_is_a_miss_only_in_pixels():
    R, t, _, _ = poses(2, 7)
    behind = t * torch.tensor([[1.0, 1, 1], [1, 1, -1]])
    for error in IN_PIXELS.values():
        assert error(R, behind, R, t, cloud(5)).tolist() == [0, math.inf]
    assert mssd(R, behind, R, t, cloud(5)).isfinite().all()


def test_mahalanobis_distance_equals_scipy():
    R_est, t_est, R_gt, t_gt = poses(6, 4)
    root = torch.from_numpy(np.random.default_rng(4).normal(size=(6, 6, 6)))
    covariance = root @ root.mT + 0.01 * torch.eye(6)
    turns = Rotation.from_matrix(R_gt.numpy()) * Rotation.from_matrix(R_est.numpy()).inv()
    steps = np.column_stack([turns.as_rotvec(), (t_gt - t_est).numpy()])
    expected = [
        scipy_distance.mahalanobis(step, np.zeros(6), np.linalg.inv(first.numpy()))
        for step, first in zip(steps, covariance, strict=True)
    ]
    assert_allclose(mahalanobis(R_est, t_est, R_gt, t_gt, covariance), expected, rtol=1e-6)


def test_the_mahalanobis_distance_is_the_smallest_over_symmetries():
    R, t, _, _ = poses(5, 5)
    group = torch.from_numpy(np.stack([np.eye(4), HALF_TURN]))
    turned = R @ group[1, :3, :3], t + R @ group[1, :3, 3]
    stated = torch.eye(6).expand(5, 6, 6)
    assert_allclose(mahalanobis(R, t, *turned, stated, group), 0, atol=1e-7)
    assert (mahalanobis(R, t, *turned, stated) > 3).all()  # half a turn is π


def test_mahalanobis_distance_without_a_covariance_is_infinite():
    R, t, _, _ = poses(4, 6)
    covariance = torch.eye(6).tile(4, 1, 1)
    covariance[1] = math.nan
    covariance[2] = 0.0
    assert mahalanobis(R, t, R, t, covariance).tolist() == [0, math.inf, math.inf, 0]
    t[3, 0] = math.nan
    assert mahalanobis(R, t, R, t, covariance)[3] == math.inf
    with pytest.raises(ValueError, match=r"covariance must be \(N, 6, 6\)"):
        mahalanobis(R, t, R, t, covariance[:2])
    assert mahalanobis(R[:0], t[:0], R[:0], t[:0], covariance[:0]).shape == (0,)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", range(4))
def test_a_pose_that_is_not_finite_is_a_miss(bad, which):
    pose = poses(3, 8)
    pose[which][1] = bad
    for error in ERRORS.values():
        assert error(*pose, cloud(10)).isinf().tolist() == [False, True, False]
    single = rotation_error_deg(pose[0], pose[2]), translation_error(pose[1], pose[3])
    assert single[which % 2][1] == math.inf


def test_no_poses_have_no_errors():
    none = [pose[:0] for pose in poses(1, 0)]
    errors = [error(*none, cloud(5)) for error in ERRORS.values()]
    errors += [rotation_error_deg(none[0], none[2]), translation_error(none[1], none[3])]
    assert {error.shape for error in errors} == {(0,)}


@pytest.mark.parametrize(
    ("pose", "points", "message"),
    [
        ([x[0] for x in poses(1, 0)], cloud(3), "poses must be (N, 3, 3), (N, 3)"),
        ((*poses(2, 0)[:3], poses(1, 0)[3]), cloud(3), "poses must be (N, 3, 3), (N, 3)"),
        (poses(1, 0), torch.empty(0, 3), "points must be (V, 3) with V >= 1"),
        (poses(1, 0), cloud(3)[0], "points must be (V, 3) with V >= 1"),
    ],
)
def test_wrong_shapes_are_refused(pose, points, message):
    for error in ERRORS.values():
        with pytest.raises(ValueError, match=re.escape(message)):
            error(*pose, points)
    with pytest.raises(ValueError, match=r"K must be \(3, 3\) or \(N, 3, 3\)"):
        reprojection_error(*poses(3, 0), cloud(3), torch.eye(3).expand(2, 3, 3))


def test_single_precision_inputs_are_computed_in_double():
    rounded = [pose.float() for pose in (*poses(3, 9), cloud(10))]
    result = add(*rounded)
    assert result.dtype == torch.float64
    assert torch.equal(result, add(*(item.double() for item in rounded)))
