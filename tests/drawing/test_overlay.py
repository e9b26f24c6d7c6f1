"""Wireframes: their lines have the right position and colour, and nothing else is drawn."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from dopepp.drawing.overlay import BLUE, GREEN, YELLOW, Wireframe, draw_wireframe, enlarge, overlay
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints, resize_points
from dopepp.geometry.cuboid import CENTROID, EDGES, cuboid_keypoints
from dopepp.geometry.rotation import random_rotation

K = camera_matrix(200, 200, 79.5, 59.5)
CUBE = cuboid_keypoints(np.full(3, -0.05), np.full(3, 0.05))
TURN = random_rotation(np.random.default_rng(0))


def black(width=160, height=120):
    return np.zeros((height, width, 3), np.uint8)


def keypoints(R=TURN):
    return project_keypoints(CUBE, make_transform(R, np.array([0, 0, 0.4])), K)


@pytest.mark.parametrize("colour", [YELLOW, GREEN, BLUE])
def test_all_edges_and_the_centroid_are_drawn_in_the_colour(colour):
    points, image_before = keypoints(), black()
    image = draw_wireframe(image_before, points, colour)
    overlay(image_before, [Wireframe(points, colour, "a")])
    assert not image_before.any()  # the input is unchanged
    direction = np.array(colour) / np.linalg.norm(colour)
    for a, b in EDGES:
        u, v = np.rint((points[a] + points[b]) / 2).astype(int)
        around = image[v - 1 : v + 2, u - 1 : u + 2].reshape(-1, 3).astype(float)
        brightest = around[around.sum(axis=1).argmax()]
        assert np.linalg.norm(brightest) > 0.5 * np.linalg.norm(colour)
        assert brightest / np.linalg.norm(brightest) @ direction > 0.99
    u, v = np.rint(points[CENTROID]).astype(int)
    assert image[v, u].tolist() == list(colour)
    drawn = np.argwhere(image.any(axis=2))[:, ::-1]  # nothing is drawn away from the lines
    lower, upper = points.min(axis=0) - 3, points.max(axis=0) + 3
    assert ((drawn > lower) & (drawn < upper)).all()


def test_a_line_lies_on_its_sub_pixel_position():
    points = np.full((9, 2), math.nan)
    points[[4, 5]] = [[20, 50.5], [140, 50.5]]  # a back edge, half way between two rows
    image = draw_wireframe(black(), points, (200, 200, 200)).astype(float)
    weights = image[:, 80, 0]
    assert weights @ np.arange(120) / weights.sum() == pytest.approx(50.5, abs=0.1)


def test_all_24_orientations_of_a_cube_look_different():
    tilt = random_rotation(np.random.default_rng(4))  # no face is seen edge-on
    rotations = tilt @ Rotation.create_group("O").as_matrix()
    images = [draw_wireframe(black(), keypoints(R)).astype(int) for R in rotations]
    assert len(images) == 24
    for a, b in itertools.combinations(images, 2):
        assert (np.abs(a - b).max(axis=2) > 60).sum() > 20


def test_edges_with_a_missing_keypoint_are_omitted():
    points = keypoints()
    points[0] = math.nan
    drawn, whole = (draw_wireframe(black(), item).any(axis=2) for item in (points, keypoints()))
    assert 0 < drawn.sum() < whole.sum()
    for missing in (math.nan, math.inf):
        assert not draw_wireframe(black(), np.full((9, 2), missing)).any()


def test_a_line_between_points_far_outside_crosses_the_image():
    points = np.full((9, 2), math.nan)
    points[[4, 5]] = [[-3e9 + 80, 60], [3e9 + 80, 60]]
    image = draw_wireframe(black(), points)
    assert image[60].any(axis=1).all()
    points[[4, 5]] = [[-1e12, -5000], [1e12, -5000]]
    assert not draw_wireframe(black(), points).any()


@given(
    arrays(np.float64, (9, 2), elements=st.floats(allow_nan=True, allow_infinity=True, width=32)),
    st.integers(1, 40),
    st.integers(1, 40),
)
def test_any_keypoints_on_any_image_are_drawn_without_an_error(points, width, height):
    frames = [Wireframe(points, BLUE, "a long name")]  # its legend is cut off
    assert overlay(black(width, height), frames, width).shape == (height, width, 3)


def test_narrow_images_and_their_keypoints_are_enlarged():
    points = keypoints()
    image = overlay(black(), [Wireframe(points, GREEN)], min_width_px=600)
    assert image.shape == (480, 640, 3)
    u, v = np.rint(resize_points(points[CENTROID], 4, 4)).astype(int)
    assert image[v, u].tolist() == list(GREEN)
    wide = black(700, 20)
    assert overlay(wide, []).shape == wide.shape


def test_enlarging_keeps_pixel_centres():
    image = black(9, 7)
    image[3, 5] = 255
    large = enlarge(image, 5).astype(float)[..., 0]
    assert large.shape == (35, 45)
    rows, columns = np.indices(large.shape)
    centre = np.array([(columns * large).sum(), (rows * large).sum()]) / large.sum()
    np.testing.assert_allclose(centre, resize_points(np.array([5.0, 3.0]), 5, 5), atol=0.05)


def test_the_legend_names_each_label_once_in_its_colour():
    nowhere = np.full((9, 2), math.nan)
    frames = [Wireframe(nowhere, GREEN, "truth"), Wireframe(nowhere, GREEN, "truth")]
    frame = overlay(black(640, 480), frames)
    assert frame.any()
    assert np.array_equal(frame, overlay(black(640, 480), frames[:1]))
    colours = frame[frame.sum(axis=2) > 300].astype(float)
    assert (colours / GREEN).std(axis=1).max() < 0.05
    assert not overlay(black(640, 480), [Wireframe(nowhere, GREEN)]).any()
