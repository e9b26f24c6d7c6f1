from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopepp.drawing.curves import figure_image
from dopepp.drawing.panels import PlotLine, grid, lines_figure, message_picture, smoothed


def line(values: np.ndarray, name: str = "dope", colour: str = "C0") -> PlotLine:
    return PlotLine(name, np.arange(values.shape[1], dtype=float), values, colour)


def test_several_runs_are_a_mean_in_a_band() -> None:
    figure = lines_figure([line(np.array([[1.0, 2.0], [3.0, 6.0]]))], "step", "loss", log_y=True)
    (axes,) = figure.axes
    (mean,) = axes.lines
    assert list(np.asarray(mean.get_ydata())) == [2.0, 4.0]
    (band,) = axes.collections
    edges = band.get_paths()[0].vertices
    assert {tuple(point) for point in np.asarray(edges)} >= {(0, 1), (1, 2), (0, 3), (1, 6)}
    assert (axes.get_yscale(), axes.get_ylabel()) == ("log", "loss")
    assert figure_image(figure).std() > 5


def test_losses_that_are_not_positive_are_not_drawn_on_a_logarithm() -> None:
    figure = lines_figure([line(np.array([[1.0, 0.0]]))], "step", "loss", log_y=True)
    assert figure.axes[0].get_yscale() == "linear"
    assert lines_figure([], "step", "loss", log_y=True).axes[0].get_legend() is None


def test_a_long_line_is_drawn_pale_and_smooth() -> None:
    noisy = np.random.default_rng(0).normal(1, 0.5, (1, 500))
    pale, smooth = lines_figure([line(noisy)], "step", "loss").axes[0].lines
    assert np.std(np.asarray(smooth.get_ydata())) < 0.5 * np.std(np.asarray(pale.get_ydata()))
    assert [one.get_label() for one in (pale, smooth)][1] == "dope"


def test_what_is_compared_with_is_dashed() -> None:
    one = line(np.ones((1, 3)))
    figure = lines_figure([replace(one, dashed=True), one], "step", "loss")
    assert [drawn.get_linestyle() for drawn in figure.axes[0].lines] == ["--", "-"]


@settings(max_examples=30, deadline=None)
@given(num=st.integers(1, 400), slope=st.floats(-3, 3))
def test_smoothing_keeps_length_level_and_straight_lines(num: int, slope: float) -> None:
    values = 5 + slope * np.arange(num, dtype=float)
    result = smoothed(values)
    assert result.shape == values.shape
    margin = num // 50
    inner = slice(margin, num - margin)
    # An even window lies half a step beside its place.
    np.testing.assert_allclose(result[inner], values[inner], atol=abs(slope) / 2 + 1e-9)
    np.testing.assert_allclose(smoothed(np.full(num, 2.5)), 2.5)


def test_pictures_stand_in_rows() -> None:
    pictures = [np.full((2 + i, 3 + i, 3), 10 * i, np.uint8) for i in range(3)]
    sheet = grid(pictures, 2)
    assert sheet.shape == (3 + 4, 3 + 4, 3)
    assert (sheet[:3, 3:7] == 10).all()
    assert (sheet[3:, :5] == 20).all()
    assert (sheet[2, :3] == 255).all()
    for wrong in (([], 1), (pictures, 0)):
        with pytest.raises(ValueError, match="a grid needs"):
            grid(*wrong)


def test_a_message_is_cut_where_the_picture_ends() -> None:
    picture = message_picture(120, 60, "no file anywhere " * 50)
    assert picture.shape == (60, 120, 3)
    assert picture.std() > 1
    assert (message_picture(40, 30, "")[0] == picture[0, :40]).all()
