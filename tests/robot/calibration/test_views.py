"""Of a video, the views that differ are kept, each where the board moved least."""

import numpy as np

from dopepp.robot.calibration.board import Sighting, parse_board
from dopepp.robot.calibration.lens import MAX_VIEWS, Views

POINTS = parse_board("charuco:8x6:25:19").points


def at(x, name, points=POINTS):
    return Sighting(name, points, 1000 * points[:, :2] + [x, 0])


def test_frames_that_add_nothing_give_way_to_stiller_ones():
    views = Views(1000)
    # It comes, rests at 100, leaves, rests at 300: steps of 30, 10, 2, 30 … pixels.
    places = [60, 90, 100, 102, 130, 200, 260, 290, 300, 300, 310]
    new = [views.offer(at(x, str(x))) for x in places]
    assert new == [True] + 4 * [False] + [True, True] + 4 * [False]
    assert [one.name for one in views.kept] == ["102", "200", "300"]


def test_other_corners_of_the_board_are_another_view():
    views = Views(1000)
    assert views.offer(at(0, "left", POINTS[:15]))
    assert views.offer(at(0, "right", POINTS[15:]))
    assert not views.offer(at(0, "left again", POINTS[:15]))


def test_there_are_never_too_many():
    views = Views(1000)
    for number in range(MAX_VIEWS):
        assert not views.is_full
        views.offer(at(50 * number, str(number)))
    assert views.is_full


def test_turned_boards_differ():
    views = Views(1000)
    turned = Sighting("turned", POINTS, 1000 * POINTS[:, :2] @ np.array([[0.0, 1], [-1, 0]]))
    assert views.offer(at(0, "straight"))
    assert views.offer(turned)
