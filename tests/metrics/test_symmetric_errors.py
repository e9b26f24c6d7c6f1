"""MSSD, MSPD, symmetric rotation error, ADD-S and the symmetry group against brute force."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from dopepp.geometry.symmetry import symmetry_group
from dopepp.metrics.functional import add_s, mspd, mssd, rotation_error_deg

Array = NDArray[np.float64]
K = np.array([[520.0, 0, 311], [0, 530, 252], [0, 0, 1]])


def poses(n: int, seed: int) -> tuple[Array, Array, Array, Array]:
    rng = np.random.default_rng(seed)
    R_gt = Rotation.random(n, random_state=rng)
    R_est = R_gt * Rotation.from_rotvec(rng.normal(0, 0.4, (n, 3)))
    t_gt = rng.normal([0, 0, 1], 0.1, (n, 3))
    return R_est.as_matrix(), t_gt + rng.normal(0, 0.02, (n, 3)), R_gt.as_matrix(), t_gt


def cloud(n: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-0.05, 0.05, (n, 3)) * [1, 0.7, 0.3]


def tensors(*arrays: Array) -> list[Tensor]:
    return [torch.from_numpy(np.asarray(array)) for array in arrays]


def half_turn() -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([-1.0, -1.0, 1.0]), [0.01, -0.02, 0.0]
    return T


def moved(R: Array, t: Array, points: Array) -> Array:
    return np.array([R @ point + t for point in points])


def pixels(points: Array) -> Array:
    seen = points @ K.T
    return np.asarray(seen[..., :2] / seen[..., 2:])


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    count=st.sampled_from([1, 2, 8, 9, 200]),
    turning=st.sampled_from([None, (0.0, 0.0, 1.0), (1.0, -1.0, 0.5)]),
    is_near=st.booleans(),
)
def test_mssd_and_mspd_are_their_formulas(seed, count, turning, is_near):
    """Also where most symmetries are left out early, because others are surely nearer."""
    axes = [(turning, (0.01, 0.0, 0.0))] if turning else []
    group = symmetry_group(half_turn()[None], axes, 0.2)
    R_est, t_est, R_gt, t_gt = poses(4, seed)
    if is_near:  # true up to a symmetry and a little: many symmetries come close to the best
        some = group[np.random.default_rng(seed).integers(len(group), size=4)]
        R_est, t_est = R_gt @ some[:, :3, :3], t_gt + (R_gt @ some[:, :3, 3:])[..., 0] + 1e-4
    t_gt[3, 2] = 0.0  # some of its points are behind the camera
    points = cloud(count, seed)
    symmetric = points @ group[:, :3, :3].transpose(0, 2, 1) + group[:, None, :3, 3]
    surface, image = [], []
    for n in range(4):
        estimated, true = points @ R_est[n].T + t_est[n], symmetric @ R_gt[n].T + t_gt[n]
        surface.append(np.linalg.norm(estimated - true, axis=-1).max(axis=1).min())
        off = np.linalg.norm(pixels(estimated) - pixels(true), axis=-1)
        off[(true[..., 2] <= 0) | (estimated[:, 2] <= 0)] = np.inf
        image.append(off.max(axis=1).min())
    arguments = tensors(R_est, t_est, R_gt, t_gt, points)
    symmetries = torch.from_numpy(group)
    found = mssd(*arguments, symmetries), mspd(*arguments, torch.from_numpy(K), symmetries)
    np.testing.assert_allclose(found[0], surface, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found[1], image, rtol=1e-9, atol=1e-9)


def test_mspd_ignores_the_last_row_of_k():
    arguments = tensors(*poses(5, 0), cloud(20))
    odd = torch.from_numpy(K).clone()
    odd[2] = torch.tensor([0.1, 0.2, 2.0])
    np.testing.assert_array_equal(mspd(*arguments, odd), mspd(*arguments, torch.from_numpy(K)))


def test_symmetries_are_taken_as_they_are():
    R, t = torch.eye(3).double()[None], torch.tensor([[0.0, 0.0, 1.0]])
    only_half_turn = torch.from_numpy(half_turn()[None])
    assert float(mssd(R, t, R, t, torch.from_numpy(cloud(9)), only_half_turn)[0]) > 0.01
    rotations = only_half_turn[:, :3, :3]
    assert float(rotation_error_deg(R, R, rotations)[0]) == pytest.approx(180)
    for wrong in (torch.eye(4), torch.zeros(0, 4, 4), torch.zeros(2, 3, 4)):
        with pytest.raises(ValueError, match="symmetries must be"):
            mssd(R, t, R, t, torch.from_numpy(cloud(9)), wrong)


def test_misses_are_infinite_and_behind_the_camera_is_a_miss():
    R_est, t_est, R_gt, t_gt = tensors(*poses(3, 3))
    points = torch.from_numpy(cloud(10))
    t_est[0], t_est[1, 2] = torch.nan, -1.0
    far = mspd(R_est, t_est, R_gt, t_gt, points, torch.from_numpy(K))
    assert far.isinf().tolist() == [True, True, False]
    assert mssd(R_est, t_est, R_gt, t_gt, points).isinf().tolist() == [True, False, False]


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    count=st.sampled_from([1, 2, 7, 8, 9, 16, 17, 33, 200, 1000]),
    scale=st.floats(0.5, 2.0),
)
def test_add_s_is_exact_for_any_matrix(seed, count, scale):
    """Rotations, scaled ones, skewed ones, and one that is flat."""
    R_est, t_est, R_gt, t_gt = poses(5, seed)
    R_est[1] *= scale
    R_est[2] += 0.3 * np.random.default_rng(seed).normal(size=(3, 3))
    R_est[3, :, 0] = 0.0
    R_est[4] = 0.0
    points = cloud(count, seed)
    points[count // 2 :] = points[: count - count // 2]  # ties
    expected = [
        KDTree(moved(R_est[n], t_est[n], points)).query(moved(R_gt[n], t_gt[n], points))[0].mean()
        for n in range(5)
    ]
    found = add_s(*tensors(R_est, t_est, R_gt, t_gt, points))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_group_of_a_can():
    """A can: any turn about its axis, and upside down. The axis misses the origin."""
    axis_point = np.array([0.02, -0.01, 0.0])
    upside_down = np.eye(4)
    upside_down[:3, :3] = np.diag([1.0, -1.0, -1.0])
    upside_down[:3, 3] = axis_point - upside_down[:3, :3] @ axis_point
    group = symmetry_group(upside_down[None], [((0.0, 0.0, 2.0), tuple(axis_point))], 0.01)
    assert group.shape == (2 * 315, 4, 4)
    np.testing.assert_array_equal(group[0], np.eye(4))
    np.testing.assert_allclose(
        group[:, :3, :3] @ group[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (630, 1, 1)),
        atol=1e-12,
    )  # fmt: skip
    on_axis = group[:, :3, :3] @ axis_point + group[:, :3, 3]
    np.testing.assert_allclose(on_axis, np.tile(axis_point, (630, 1)), atol=1e-12)
    angles = Rotation.from_matrix(group[:315, :3, :3]).magnitude()
    assert np.diff(np.sort(angles)).max() < 2 * 0.01
    # It is a group: the product of two of its members is one of them.
    product = group[7] @ group[400]
    assert np.abs(group - product).max(axis=(1, 2)).min() < 1e-12


def test_a_bad_axis_or_step_is_refused():
    with pytest.raises(ValueError, match="axis of symmetry"):
        symmetry_group(None, [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))])
    with pytest.raises(ValueError, match="max_step"):
        symmetry_group(max_step=0.0)
