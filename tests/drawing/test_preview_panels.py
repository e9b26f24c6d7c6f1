"""Panels of a preview sheet: the right pixels in the right colours."""

from __future__ import annotations

import numpy as np
import pytest

from dopepp.drawing.panels import AXIS_COLOURS, COLOURS, depth_panel, draw_axes, mask_panel

GREY = np.full((30, 40, 3), 100, np.uint8)


def test_masks_are_painted_in_their_colours_on_the_darkened_image() -> None:
    first, second = np.zeros((2, 30, 40), bool)
    first[5:10, 5:15] = True
    second[20:25, 20:30] = True
    panel = mask_panel(GREY, [first, None, second]).astype(int)
    assert (panel[0, 0] == 35).all()
    for mask, colour in ((first, COLOURS[0]), (second, COLOURS[2])):
        expected = 0.35 * 100 + 0.65 * np.array(colour)
        assert np.abs(panel[mask] - expected).max() <= 1
    assert (mask_panel(GREY, []) == 35).all()


def test_more_instances_than_colours_begin_again() -> None:
    masks = [np.ones((30, 40), bool)] * (len(COLOURS) + 1)
    assert (mask_panel(GREY, masks) == mask_panel(GREY, masks[:1])).all()


def test_depth_goes_from_red_over_the_objects_range_to_blue() -> None:
    depth = np.full((30, 40), 9.0, np.float32)  # a plane far behind
    depth[:, :20] = np.linspace(0.2, 0.4, 20)
    depth[0] = 0
    objects = np.zeros((30, 40), bool)
    objects[:, :20] = True
    panel, words = depth_panel(depth, objects)
    assert words == "depth: red 0.180 m to blue 0.420 m"
    assert (panel[0] == 0).all()
    red, blue = panel[5, 0].astype(int), panel[5, 19].astype(int)
    assert red[0] > red[2] + 100
    assert blue[2] > blue[0] + 100
    assert (panel[5, 20:] == panel[5, 20]).all()


def test_depth_without_objects_and_without_anything() -> None:
    nothing = np.zeros((30, 40), bool)
    assert depth_panel(np.full((30, 40), 1.0), nothing)[1] == "depth: red 0.999 m to blue 1.001 m"
    panel, words = depth_panel(np.zeros((30, 40)), nothing)
    assert words == "no depth"
    assert not panel.any()


def test_axes_end_where_they_should() -> None:
    image = np.zeros((60, 80, 3), np.uint8)
    draw_axes(image, np.array([[20.0, 30], [70, 30], [20, 5], [20, 55]]), thickness=1)
    for (column, row), colour in zip([(60, 30), (20, 8), (20, 50)], AXIS_COLOURS, strict=True):
        # An antialiased line of one pixel keeps nine tenths of its colour at least.
        assert np.abs(image[row, column].astype(int) - colour).max() < 0.1 * 255 + 1
    assert image[30, 75].sum() == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e12])
def test_an_axis_that_is_not_seen_is_left_out(bad: float) -> None:
    image = np.zeros((60, 80, 3), np.uint8)
    draw_axes(image, np.array([[20.0, 30], [bad, bad], [20, 5], [20, 55]]))
    assert image[10, 20].any()
    assert not image[30, 40:].any()
    draw_axes(image, np.full((4, 2), bad))
