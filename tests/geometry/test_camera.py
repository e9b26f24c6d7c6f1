from contextlib import nullcontext

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import (
    ANYWHERE,
    INSIDE,
    WHOLE,
    Letterbox,
    camera_matrix,
    check_camera,
    invert_transform,
    make_transform,
    move_pose,
    project,
    resize_camera,
    resize_points,
    step_between,
    transform,
)
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix

K = camera_matrix(600, 610, 310.5, 245.25)


def random_pose(rng):
    return make_transform(random_rotation(rng), rng.uniform([-0.1, -0.1, 0.4], [0.1, 0.1, 1.0]))


def test_projection_is_opencvs():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.1, 0.1, (40, 3))
    vector, translation = rng.normal(size=3), np.array([0.03, -0.02, 0.5])
    T_cam_obj = make_transform(rotation_vector_to_matrix(vector), translation)
    expected = cv2.projectPoints(points, vector, translation, K, None)[0][:, 0]
    assert_allclose(project(transform(T_cam_obj, points), K), expected, atol=1e-9)


@pytest.mark.filterwarnings("error")
def test_points_behind_the_camera_have_no_pixel():
    points = np.array([[0, 0, 1], [0.1, 0.2, 0], [0.1, 0.2, -1], [np.nan, 0, 1], [1, 1, 1e-320]])
    pixels = project(points, K)
    assert_allclose(pixels[0], K[:2, 2])
    assert np.isnan(pixels[1:4]).all()


def test_transforms_invert():
    rng = np.random.default_rng(2)
    T, points = random_pose(rng), rng.normal(size=(2, 5, 3))
    assert_allclose(invert_transform(T), np.linalg.inv(T), atol=1e-12)
    assert_allclose(transform(invert_transform(T), transform(T, points)), points, atol=1e-12)


def test_a_resized_camera_projects_to_resized_points():
    rng = np.random.default_rng(3)
    points = rng.uniform([-0.2, -0.2, 0.5], [0.2, 0.2, 1], (20, 3))
    expected = resize_points(project(points, K), 0.65, 1.7)
    assert_allclose(project(points, resize_camera(K, 0.65, 1.7)), expected, atol=1e-9)
    assert_array_equal(K, camera_matrix(600, 610, 310.5, 245.25))


SIZES = st.tuples(st.integers(1, 3000), st.integers(1, 3000))


@settings(max_examples=100)
@given(SIZES, SIZES)
def test_a_letterbox_fits_and_can_be_inverted(size, input_size):
    box = Letterbox.fit(size, input_size)
    assert 1 <= box.width <= input_size[0]
    assert 1 <= box.height <= input_size[1]
    assert box.width == input_size[0] or box.height == input_size[1]
    scale = min(input_size[0] / size[0], input_size[1] / size[1])
    assert abs(box.width - size[0] * scale) <= max(0.5, 1 - size[0] * scale) + 1e-9
    assert abs(box.height - size[1] * scale) <= max(0.5, 1 - size[1] * scale) + 1e-9

    corners = np.array([[-0.5, -0.5], [size[0] - 0.5, size[1] - 0.5]])
    assert_allclose(box.points(corners), [[-0.5, -0.5], [box.width - 0.5, box.height - 0.5]])
    assert_allclose(box.original_points(box.points(corners)), corners, atol=1e-9)
    ray = np.array([0.1, -0.2, 1.0])
    assert_allclose(project(ray, box.camera(K)), box.points(project(ray, K)), atol=1e-6)


@pytest.mark.parametrize("input_size", [(128, 128), (416, 416), (64, 300)])
def test_a_letterbox_moves_image_and_points_alike(input_size):
    grid_y, grid_x = np.mgrid[:150, :200]
    blob = 255 * np.exp(-((grid_x - 120.4) ** 2 + (grid_y - 60.8) ** 2) / (2 * 8.0**2))
    image = np.repeat(np.round(blob).astype(np.uint8)[..., None], 3, axis=2)
    box = Letterbox.fit((200, 150), input_size)
    resized = box.image(image)
    assert (resized.shape, resized.dtype) == ((box.height, box.width, 3), np.uint8)
    rows, columns = np.mgrid[: box.height, : box.width]
    weight = resized[..., 1].astype(float)
    centre = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    assert_allclose(centre, box.points(np.array([120.4, 60.8])), atol=0.1)


def test_a_letterbox_averages_when_shrinking():
    checkers = np.indices((64, 64)).sum(0) % 2 * np.uint8(255)
    image = np.repeat(checkers[..., None].astype(np.uint8), 3, axis=2)
    assert np.abs(Letterbox.fit((64, 64), (16, 16)).image(image).astype(int) - 128).max() <= 1
    assert Letterbox.fit((64, 64), (64, 96)).image(image) is image


def test_the_rounding_of_a_calibration_file_is_removed():
    rounding = 1e-8 * np.array([[0, 1, 0], [1, 0, 0], [1, -1, 1.0]])
    assert_array_equal(check_camera(K + rounding, (640, 480), "test"), K)
    assert check_camera(K.astype(np.float32), (640, 480), "test").dtype == np.float64


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        *((bad, "3×3 pinhole") for bad in (np.eye(2), np.zeros(9), np.full((3, 3), np.nan))),
        *((bad, "3×3 pinhole") for bad in ("calibration.yaml", [[1, 2, 3], [4, 5], [6]])),
        *((bad, "3×3 pinhole") for bad in (K.T, 2 * K, K + 5 * np.eye(3, k=1))),
        (K + np.array([[0, 0, 0], [5.0, 0, 0], [0, 0, 0]]), "3×3 pinhole"),
        (camera_matrix(600, 600, 700, 240), "principal point inside"),
        (camera_matrix(600, 600, 320, -1), "principal point inside"),
        (camera_matrix(-600, 600, 320, 240), "field of view"),
        (camera_matrix(0.6, 0.6, 320, 240), "field of view"),
        (camera_matrix(60000, 60000, 320, 240), "field of view"),
    ],
)
def test_bad_camera(bad, message):
    with pytest.raises(UserError, match=message) as caught:
        check_camera(bad, (640, 480), "frame 7")
    assert "frame 7" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("off_centre", "good", "bad"),
    [
        (WHOLE, [(0.5, 0.5), (0.31, 0.69)], [(0.29, 0.5), (0.5, 0.71)]),
        (INSIDE, [(0.01, 0.99)], [(-0.01, 0.5)]),
        (ANYWHERE, [(-7.0, 30.0)], []),
    ],
)
def test_the_principal_point_has_a_largest_offset(off_centre, good, bad):
    def check(x, y):
        own = camera_matrix(600, 600, 640 * x - 0.5, 480 * y - 0.5)
        assert_array_equal(check_camera(own, (640, 480), "test", off_centre), own)

    for x, y in good:
        check(x, y)
    for x, y in bad:
        with pytest.raises(UserError, match=f"at {x:.0%} of its width"):
            check(x, y)


@pytest.mark.parametrize("scale", [0.25, 0.5, 1.5, 2.0])
def test_the_k_of_another_resolution_is_refused_with_its_likely_size(scale):
    """The image is a quarter to twice as large as the image for which K holds."""
    size = (round(640 / scale), round(480 / scale))
    with pytest.raises(UserError) as caught:
        check_camera(K, size, "p.png", WHOLE)
    for text in ("likely of 622×492", f"{size[0]}×{size[1]} image of p.png", "field of view"):
        assert text in str(caught.value)


@pytest.mark.parametrize(("degrees", "good"), [(4.8, False), (5, True), (150, True), (151, False)])
def test_the_field_of_view_is_5_to_150_degrees(degrees, good):
    focal = 320 / np.tan(np.radians(degrees) / 2)
    own = camera_matrix(focal, focal, 319.5, 239.5)
    refusal = pytest.raises(UserError, match=f"field of view {degrees:g}°")
    with nullcontext() if good else refusal:
        check_camera(own, (640, 480), "test", WHOLE)
    if degrees < 5:  # allowed for a crop
        check_camera(own, (640, 480), "test", ANYWHERE)


def test_the_step_between_two_poses_moves_the_first_to_the_second():
    rng = np.random.default_rng(4)
    for _ in range(20):
        before, after = (make_transform(random_rotation(rng), rng.normal(size=3)) for _ in "ab")
        step = step_between(before, after)
        turn = Rotation.from_matrix(after[:3, :3]) * Rotation.from_matrix(before[:3, :3]).inv()
        assert_allclose(step[:3], turn.as_rotvec(), atol=1e-9)
        assert_allclose(step[3:], after[:3, 3] - before[:3, 3])
        assert_allclose(move_pose(before, step), after, atol=1e-12)
