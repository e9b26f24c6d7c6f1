import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from dopepp.geometry.rotation import (
    is_rigid,
    is_rotation,
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    nearest_rotation,
    quaternion_to_matrix,
    random_rotation,
    rotation_angle,
    rotation_vector_to_matrix,
)

AXES, QUATERNIONS = (
    st.lists(st.floats(-1, 1), min_size=n, max_size=n).filter(lambda x: np.linalg.norm(x) > 1e-3)
    for n in (3, 4)
)
SMALL = st.floats(0, 1e-6)
wide = settings(max_examples=100)


@wide
@given(QUATERNIONS)
def test_quaternion_to_matrix_is_scipys(quaternion):
    w, x, y, z = quaternion
    expected = Rotation.from_quat([x, y, z, w]).as_matrix()
    assert_allclose(quaternion_to_matrix(np.array(quaternion)), expected, atol=1e-12)


@wide
@given(QUATERNIONS)
def test_matrix_to_quaternion_is_scipys_up_to_sign(quaternion):
    matrix = Rotation.from_quat(quaternion).as_matrix()
    x, y, z, w = Rotation.from_matrix(matrix).as_quat()
    result = matrix_to_quaternion(matrix)
    assert result[0] >= 0
    assert np.linalg.norm(result) == pytest.approx(1)
    assert abs(result @ [w, x, y, z]) == pytest.approx(1, abs=1e-12)


@wide
@given(AXES, st.sampled_from([0.0, 1e-12, 1e-6, 0.1, 2.0, 3.14]))
def test_rotation_vectors_survive_a_round_trip(axis, angle):
    vector = angle * np.array(axis) / np.linalg.norm(axis)
    result = matrix_to_rotation_vector(rotation_vector_to_matrix(vector))
    assert_allclose(result, vector, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_have_a_quaternion(axis):
    matrix = 2 * np.outer(axis, axis) - np.eye(3)
    assert_allclose(quaternion_to_matrix(matrix_to_quaternion(matrix)), matrix, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_quaternions_of_any_norm(scale):
    quaternion = np.array([0.5, -0.5, 0.5, 0.5])
    assert_allclose(quaternion_to_matrix(scale * quaternion), quaternion_to_matrix(quaternion))


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 0]])
def test_zero_and_infinite_quaternions_are_refused(bad):
    with pytest.raises(ValueError, match="finite and non-zero"):
        quaternion_to_matrix(np.array(bad))


@wide
@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3))
def test_rotation_vector_is_scipys(vector):
    expected = Rotation.from_rotvec(vector).as_matrix()
    assert_allclose(rotation_vector_to_matrix(np.array(vector)), expected, atol=1e-12)


def test_batches_of_rotations_down_to_zero():
    vectors = np.array([[[0.0, 0, 0], [1e-300, 0, 0]], [[1e-9, 2e-9, 0], [0.3, 0.2, -3]]])
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3))
    matrices = expected.as_matrix().reshape(2, 2, 3, 3)
    assert_allclose(rotation_vector_to_matrix(vectors), matrices, atol=1e-15)
    assert_allclose(rotation_angle(matrices), expected.magnitude().reshape(2, 2), atol=1e-12)


@wide
@given(AXES, st.floats(0, np.pi) | SMALL | SMALL.map(lambda small: np.pi - small))
def test_rotation_angle_keeps_its_digits_near_0_and_pi(axis, angle):
    vector = np.array(axis) / np.linalg.norm(axis) * angle
    rotation = Rotation.from_rotvec(vector)
    assert rotation_angle(rotation.as_matrix()) == pytest.approx(rotation.magnitude(), abs=1e-12)


def test_random_rotations_are_uniform():
    """Over SO(3) the angle's distribution function is (θ − sin θ)/π, and no axis is preferred."""
    rng = np.random.default_rng(0)
    rotations = np.stack([random_rotation(rng) for _ in range(4000)])
    angles = np.sort(rotation_angle(rotations))
    expected = (angles - np.sin(angles)) / np.pi
    assert np.abs(expected - np.linspace(0, 1, 4000)).max() < 0.03  # Kolmogorov: 0.026 at 1 %
    assert np.abs(rotations.mean(0)).max() < 0.04


@given(st.integers(0, 2**32 - 1))
def test_the_nearest_rotation_is_the_polar_factor(seed):
    rng = np.random.default_rng(seed)
    bent = random_rotation(rng) + rng.normal(scale=0.05, size=(4, 3, 3))
    result = nearest_rotation(bent)
    assert_allclose(result, [polar(item)[0] for item in bent], atol=1e-12)
    # A mirrored matrix also gives a rotation, and no neighbouring rotation is nearer.
    mirrored = -bent[0]
    (nearest,) = nearest_rotation(mirrored[None])
    assert is_rotation(nearest, 1e-9)
    neighbours = Rotation.from_rotvec(rng.normal(scale=0.05, size=(50, 3))).as_matrix() @ nearest
    distances = np.linalg.norm(neighbours - mirrored, axis=(1, 2))
    assert (distances >= np.linalg.norm(nearest - mirrored)).all()


@pytest.mark.parametrize(
    ("entry", "value", "expected"),
    [
        ((0, 3), 0.5, True),
        ((0, 3), np.nan, False),
        ((0, 0), 1.1, False),
        ((2, 2), -1.0, False),
        ((3, 0), 0.1, False),
    ],
)
def test_a_rigid_transform_is_a_rotation_a_finite_shift_and_a_last_row(entry, value, expected):
    T = np.eye(4)
    T[entry] = value
    assert is_rigid(T) is expected
    assert not is_rigid(T[:3])
