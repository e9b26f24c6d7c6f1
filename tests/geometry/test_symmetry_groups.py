import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from dopepp.geometry.symmetry import exact_group, symmetry_group


def is_group(elements):
    """Return whether every product is an element, up to rounding."""
    products = (elements[:, None] @ elements[None]).reshape(-1, 1, 9)
    return np.abs(products - elements.reshape(1, -1, 9)).max(axis=2).min(axis=1).max() < 1e-9


@pytest.mark.parametrize("name", ["C7", "C12", "D2", "D6", "D12", "T", "O", "I"])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=5)
def test_measured_generators_make_the_exact_group(name, seed):
    frame = Rotation.random(random_state=seed).as_matrix()
    true = frame @ Rotation.create_group(name).as_matrix() @ frame.T
    away = np.random.default_rng(seed).normal(size=(len(true) - 1, 3))
    away *= np.radians(0.7) / np.linalg.norm(away, axis=1, keepdims=True)
    group = exact_group(Rotation.from_rotvec(away).as_matrix() @ true[1:])
    assert len(group) == len(true)
    assert (group[0] == np.eye(3)).all()
    assert is_group(group)
    nearest = np.abs(true[:, None] - group[None]).max(axis=(2, 3)).min(axis=1)
    assert nearest.max() < np.radians(1.5)


def test_rotations_of_an_infinite_group_are_refused():
    odd = Rotation.from_euler("zx", [[40, 10], [75, 50]], degrees=True).as_matrix()
    assert exact_group(odd) is None


def test_a_repeated_axis_counts_once():
    axis, again = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)), ((0.0, 0.0, -2.0), (1.0, 0.0, 3.0))
    once, twice = symmetry_group(None, [axis], 0.05), symmetry_group(None, [axis, again], 0.05)
    assert np.array_equal(once, twice)


def test_a_ball_has_rotations_all_over_and_a_bounded_number_of_them():
    centre = (0.1, -0.2, 0.3)
    axes = [(tuple(axis), centre) for axis in np.eye(3).tolist()]
    group = symmetry_group(None, axes)
    assert 5_000 < len(group) < 20_000
    assert np.array_equal(group[0], np.eye(4))
    assert np.allclose(group[:, :3, :3] @ centre + group[:, :3, 3], centre)
    wanted = Rotation.random(200, random_state=4)
    have = Rotation.from_matrix(group[:, :3, :3])
    away = [(item.inv() * have).magnitude().min() for item in wanted]
    assert max(away) < 0.2


def test_group_of_a_can():
    """A can has any rotation about its axis, which misses the origin, and a half turn."""
    axis_point = np.array([0.02, -0.01, 0.0])
    upside_down = np.eye(4)
    upside_down[:3, :3] = np.diag([1.0, -1.0, -1.0])
    upside_down[:3, 3] = axis_point - upside_down[:3, :3] @ axis_point
    group = symmetry_group(upside_down[None], [((0.0, 0.0, 2.0), tuple(axis_point))], 0.01)
    assert group.shape == (2 * 315, 4, 4)
    R = group[:, :3, :3]
    assert_array_equal(group[0], np.eye(4))
    assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    on_axis = R @ axis_point + group[:, :3, 3]
    assert_allclose(on_axis, np.broadcast_to(axis_point, (630, 3)), atol=1e-12)
    angles = Rotation.from_matrix(group[:315, :3, :3]).magnitude()
    assert np.diff(np.sort(angles)).max() < 2 * 0.01
    # The product of two members is a member.
    product = group[7] @ group[400]
    assert np.abs(group - product).max(axis=(1, 2)).min() < 1e-12


def test_an_axis_without_length_is_refused():
    with pytest.raises(ValueError, match="axis of symmetry"):
        symmetry_group(None, [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))])
