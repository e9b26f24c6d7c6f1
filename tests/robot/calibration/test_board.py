import re

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import (
    camera_matrix,
    invert_transform,
    make_transform,
    project,
    transform,
)
from dopepp.geometry.camera_file import Camera
from dopepp.robot.calibration.board import draw_view, parse_board
from tests.robot.calibration.conftest import look_at

BOARDS = ["charuco:8x6:20:15", "charuco:7x5:24.5:18:4X4_50", "chess:8x5:20", "circles:4x9:30"]


@pytest.mark.parametrize("spec", BOARDS)
@pytest.mark.parametrize("roll", [0.3, 2.0, -2.6])
def test_points_are_detected_where_the_camera_projects_them(spec, roll):
    board, rng = parse_board(spec), np.random.default_rng(0)
    camera = Camera((800, 600), camera_matrix(700, 700, 395, 310), (), "a camera")
    middle = board.points.mean(axis=0)
    T = invert_transform(look_at(middle + np.array([0.08, -0.05, -0.3]), middle, roll))
    detection = board.detect(draw_view(board, T, camera, rng), "image")
    assert len(detection.points) > 0.8 * len(board.points)
    away = project(transform(T, detection.points), camera.K) - detection.pixels
    errors = np.linalg.norm(away, axis=1)
    assert errors.max() < 0.4
    assert np.sqrt((errors**2).mean()) < 0.15


def test_no_board_is_detected_in_an_empty_image():
    empty = np.full((240, 320, 3), 128, np.uint8)
    assert all(parse_board(spec).detect(empty, "empty") is None for spec in BOARDS)


def test_points_in_a_line_are_no_detection():
    """One view with such points would make OpenCV reject the views of a whole calibration."""
    board, rng = parse_board("charuco:8x11:20:15"), np.random.default_rng(0)
    camera = Camera((640, 480), camera_matrix(600, 600, 319.5, 239.5), (), "a camera")
    R = Rotation.from_euler("xyz", [0.2, 0.1, 0.05]).as_matrix()
    image = draw_view(board, make_transform(R, np.array([-0.08, -0.11, 0.3])), camera, rng)
    for width, is_detected in ((640, True), (246, False)):  # at 246, a column of 10 points
        image[:, width:] = 110
        assert (board.detect(image, "image") is not None) == is_detected


@pytest.mark.parametrize("spec", BOARDS)
def test_a_printed_board_has_its_true_size(spec, tmp_path):
    board = parse_board(spec)
    size = board.write(tmp_path / "board.pdf")
    board.write(tmp_path / "board.png")
    inches = np.array(re.match(r"([\d.]+) × ([\d.]+) mm", size).groups(), float) / 25.4
    box = re.search(rb"/MediaBox \[([^\]]*)\]", (tmp_path / "board.pdf").read_bytes())[1].split()
    assert np.allclose(np.array(box, float), [0, 0, *(72 * inches)], atol=0.05)
    with Image.open(tmp_path / "board.png") as image:
        assert np.allclose(np.array(image.size) / image.info["dpi"], inches, rtol=1e-3)


@pytest.mark.parametrize(
    "spec", ["charuco:8x6:20.55:15", "charuco:8x6:20:15.04", "chess:8x5:20.55", "circles:4x9:20.5"]
)
def test_a_size_that_cannot_be_drawn_is_not_printed(spec, tmp_path):
    with pytest.raises(UserError, match="tenths of a millimetre"):
        parse_board(spec).write(tmp_path / "board.pdf")
    assert not list(tmp_path.iterdir())


def test_squares_of_a_printed_charuco_board_have_the_stated_length():
    page = parse_board("charuco:8x6:20:15").drawing()
    assert page.shape == (6 * 200 + 200, 8 * 200 + 200)
    assert (page[:100] == 255).all()
    assert (page[100:300, 100] < 128).all()  # the first square, at the board's corner, is black


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("", "charuco:COLUMNS"),
        ("charuco:8x6:20", "charuco:COLUMNS"),
        ("charuco:8x6:20:15:5X5_100:more", "charuco:COLUMNS"),
        ("charuco:8x6:20:25", "smaller than their squares"),
        ("charuco:8x6:20:15:NO_SUCH", "a dictionary of"),
        ("charuco:30x30:20:15:4X4_50", "at most 50 markers"),
        ("chess:8x6:20", "one even and one odd"),
        ("chess:8xsix:20", "charuco:COLUMNS"),
        ("chess:800x5:20", "at most 1200 mm"),
        ("chess:8x5:nan", "at least 1 mm"),
        ("circles:2x9:30", "at least 3×3"),
        ("circles:4x10:40", "an odd number of rows"),
        ("rings:8x5:20", "charuco:COLUMNS"),
    ],
)
def test_an_impossible_board_is_rejected(spec, message):
    with pytest.raises(UserError, match=re.escape(message)):
        parse_board(spec)


def test_two_boards_of_one_kind_are_rejected():
    board, rng = parse_board("charuco:8x6:25:19"), np.random.default_rng(0)
    camera = Camera((960, 480), camera_matrix(560, 560, 480, 240), (), "true")
    left, right = (
        draw_view(board, make_transform(np.eye(3), np.array([x, -0.07, 0.35])), camera, rng)
        for x in (-0.25, 0.02)
    )
    both = left.copy()
    both[:, 480:] = right[:, 480:]
    assert board.detect(left, "one") is not None
    with pytest.raises(UserError, match="two boards"):
        board.detect(both, "two")
