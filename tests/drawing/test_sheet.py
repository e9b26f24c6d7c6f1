"""Panels and contact sheets: positions and colours of their images."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.drawing import curves, sheet
from dopepp.drawing.curves import figure_image
from dopepp.drawing.overlay import text_coverage
from dopepp.drawing.sheet import Tile, contact_sheet, heat_image

IMAGE = np.full((30, 40, 3), 100, np.uint8)
RED, GREY = (200, 10, 10), (90, 90, 90)


def line(values, name="dope", colour="C0"):
    return curves.PlotLine(name, np.arange(values.shape[1], dtype=float), values, colour)


def test_several_runs_are_a_mean_in_a_band():
    runs = line(np.array([[1.0, 2.0], [3.0, 6.0]]))
    figure = curves.lines_figure([runs], "step", "loss", log_y=True)
    (axes,) = figure.axes
    assert (axes.get_yscale(), axes.get_ylabel()) == ("log", "loss")
    (mean,), (band,) = axes.lines, axes.collections
    assert list(mean.get_ydata()) == [2.0, 4.0]
    edges = {tuple(point) for point in band.get_paths()[0].vertices}
    assert edges >= {(0, 1), (1, 2), (0, 3), (1, 6)}
    assert figure_image(figure).std() > 5


def test_losses_that_are_not_positive_are_not_drawn_on_a_logarithm():
    lines = [line(np.array([[1.0, 0.0]]))]
    some, none = (curves.lines_figure(items, "a", "b", log_y=True).axes[0] for items in (lines, []))
    assert (some.get_yscale(), none.get_legend()) == ("linear", None)


def test_a_long_line_is_pale_with_its_average_and_a_dashed_line_stays_dashed():
    noisy = line(np.random.default_rng(0).normal(1, 0.5, (1, 500)))
    dashed = replace(line(noisy.values[:, :3]), dashed=True)
    pale, smooth, other = curves.lines_figure([noisy, dashed], "step", "loss").axes[0].lines
    assert np.std(smooth.get_ydata()) < 0.5 * np.std(pale.get_ydata())
    assert smooth.get_label() == "dope"
    assert [item.get_linestyle() for item in (smooth, other)] == ["-", "--"]


@given(num=st.integers(1, 400), slope=st.floats(-3, 3))
def test_smoothing_keeps_length_level_and_straight_lines(num, slope):
    values = 5 + slope * np.arange(num, dtype=float)
    result = curves.moving_average(values)
    assert result.shape == values.shape
    margin = num // 50
    inner = slice(margin, num - margin)
    # An even window is half a step off its centre.
    np.testing.assert_allclose(result[inner], values[inner], atol=abs(slope) / 2 + 1e-9)
    np.testing.assert_allclose(curves.moving_average(np.full(num, 2.5)), 2.5)


def test_images_are_arranged_in_rows():
    images = [np.full((2 + i, 3 + i, 3), 10 * i, np.uint8) for i in range(3)]
    expected = np.full((3 + 4, 3 + 4, 3), 255, np.uint8)
    expected[:2, :3], expected[:3, 3:7], expected[3:, :5] = 0, 10, 20
    np.testing.assert_array_equal(sheet.grid(images, 2), expected)


def test_a_message_is_cut_at_the_bottom_of_the_image():
    image = sheet.message_image(120, 60, "no file anywhere " * 50)
    assert image.shape == (60, 120, 3)
    assert image.std() > 1
    assert (sheet.message_image(40, 30, "")[0] == image[0, :40]).all()


def test_masks_are_painted_in_their_colours_on_the_darkened_image():
    first, second = np.zeros((2, 30, 40), bool)
    first[5:10, 5:15] = True
    second[20:25, 20:30] = True
    panel = sheet.mask_panel(IMAGE, [first, None, second]).astype(int)
    assert (panel[0, 0] == 35).all()
    for mask, colour in ((first, sheet.COLOURS[0]), (second, sheet.COLOURS[2])):
        expected = 0.35 * 100 + 0.65 * np.array(colour)
        assert np.abs(panel[mask] - expected).max() <= 1
    assert (sheet.mask_panel(IMAGE, []) == 35).all()
    masks = [np.ones((30, 40), bool)] * (len(sheet.COLOURS) + 1)  # the colours repeat
    assert (sheet.mask_panel(IMAGE, masks) == sheet.mask_panel(IMAGE, masks[:1])).all()


def test_depth_goes_from_red_over_the_objects_range_to_blue():
    depth = np.full((30, 40), 9.0, np.float32)  # a plane far behind
    depth[:, :20] = np.linspace(0.2, 0.4, 20)
    depth[0] = 0
    objects = np.zeros((30, 40), bool)
    objects[:, :20] = True
    panel, words = sheet.depth_panel(depth, objects)
    assert words == "depth: red 0.180 m to blue 0.420 m"
    assert (panel[0] == 0).all()
    red, blue = panel[5, 0].astype(int), panel[5, 19].astype(int)
    assert red[0] > red[2] + 100
    assert blue[2] > blue[0] + 100
    assert (panel[5, 20:] == panel[5, 20]).all()


def test_depth_without_objects_and_unknown_depth():
    nothing = np.zeros((30, 40), bool)
    _, words = sheet.depth_panel(np.full((30, 40), 1.0), nothing)
    assert words == "depth: red 0.999 m to blue 1.001 m"
    panel, words = sheet.depth_panel(np.zeros((30, 40)), nothing)
    assert words == "no depth"
    assert not panel.any()


def test_axes_have_their_ends_and_colours():
    image = np.zeros((60, 80, 3), np.uint8)
    sheet.draw_axes(image, np.array([[20.0, 30], [70, 30], [20, 5], [20, 55]]))
    near_ends = [(60, 30), (20, 8), (20, 50)]
    for (column, row), colour in zip(near_ends, sheet.AXIS_COLOURS, strict=True):
        # An anti-aliased line of one pixel has at least nine tenths of its colour.
        assert np.abs(image[row, column].astype(int) - colour).max() < 0.1 * 255 + 1
    assert image[30, 75].sum() == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e12])
def test_an_axis_far_outside_is_omitted(bad):
    image = np.zeros((60, 80, 3), np.uint8)
    sheet.draw_axes(image, np.array([[20.0, 30], [bad, bad], [20, 5], [20, 55]]))
    assert image[10, 20].any()
    assert not image[30, 40:].any()
    sheet.draw_axes(image, np.full((4, 2), bad))


def plain(colour, width=40, height=30):
    return np.full((height, width, 3), colour, np.uint8)


def test_tiles_are_in_reading_order():
    colours = [(10 * i, 100, 50) for i in range(5)]
    expected = np.full((3 * 30 + 4 * 6, 2 * 40 + 3 * 6, 3), 255, np.uint8)  # no sixth tile
    for i, colour in enumerate(colours):
        top, left = 6 + 36 * (i // 2), 6 + 46 * (i % 2)
        expected[top : top + 30, left : left + 40] = colour
    result = contact_sheet([Tile(plain(c)) for c in colours], columns=2, tile_width=40)
    np.testing.assert_array_equal(result, expected)


def test_tiles_have_one_width_and_keep_their_aspect_ratio():
    tiles = [Tile(plain(RED, 10, 20)), Tile(plain(GREY, 400, 100))]
    expected = np.full((200 + 12, 2 * 100 + 18, 3), 255, np.uint8)
    expected[6:206, 6:106], expected[6:31, 112:212] = RED, GREY
    np.testing.assert_array_equal(contact_sheet(tiles, columns=5, tile_width=100), expected)


@pytest.mark.parametrize("caption", ["ADD 3.1 mm", "Δ = 4° · a very long caption " * 9, "$x"])
def test_a_caption_is_below_its_image(caption):
    sheet = contact_sheet([Tile(plain(RED, 120, 90), caption)], tile_width=120)
    assert sheet.shape == (90 + 18 + 12, 132, 3)
    assert (sheet[6:96, 6:126] == RED).all()
    assert (sheet[96:114, 6:126] < 100).any()
    assert (sheet[114:] == 255).all()


@pytest.mark.parametrize(("count", "columns"), [(0, 2), (1, 0)])
def test_images_and_columns_are_required(count, columns):
    for make, images in ((sheet.grid, [IMAGE]), (contact_sheet, [Tile(IMAGE)])):
        with pytest.raises(ValueError, match="a grid needs images and columns"):
            make(images[:count], columns)


def test_text_fits_its_line_and_has_the_width_of_its_letters():
    short, long = text_coverage("i", 20), text_coverage("iiiiiiiiii", 20)
    assert short.shape[0] == 20
    assert 3 * short.shape[1] < long.shape[1]
    letters = text_coverage("Ågjy|", 20)
    assert letters.max() > 0.9
    assert letters[0].max() < 0.1  # nothing is cut off above or below
    assert letters[-1].max() < 0.1


def test_a_belief_covers_the_pixels_of_its_cell():
    image = np.full((90, 150, 3), 90, np.uint8)  # smaller than the maps, which include padding
    belief = np.zeros((12, 20), np.float32)
    belief[4, 11] = 1
    heat = heat_image(image, belief).astype(int)
    assert heat.shape == image.shape
    hot = np.argwhere(np.abs(heat - 54).max(axis=2) > 100)  # 54 = the dimmed grey
    np.testing.assert_allclose(hot.mean(axis=0), [8 * 4 + 3.5, 8 * 11 + 3.5], atol=0.6)
    assert (heat[:24] == 54).all()


def test_beliefs_beyond_their_range_are_clipped():
    image = np.full((96, 160, 3), 90, np.uint8)
    first, seven = (heat_image(image, np.full((12, 20), value, np.float32)) for value in (1, 7))
    np.testing.assert_array_equal(first, seven)
