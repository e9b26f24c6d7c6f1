"""Curves and the numbers in them."""

import logging
import math

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dopepp.core.files import read_csv
from dopepp.drawing.curves import (
    RateCurve,
    accuracy_curve,
    accuracy_figure,
    figure_image,
    rates_figure,
    save_accuracy_curves,
)
from dopepp.drawing.pictures import read_rgb
from dopepp.metrics.functional import auc

ERRORS = st.lists(
    st.one_of(st.floats(0, 0.2), st.sampled_from([0.0, 0.05, math.inf, math.nan])), max_size=20
)


@given(ERRORS)
def test_a_curve_counts_errors_strictly_below_a_threshold_and_its_legend_has_the_exact_auc(errors):
    thresholds, accuracy = accuracy_curve(np.array(errors))
    below = [sum(error < threshold for error in errors) for threshold in thresholds]
    assert accuracy.tolist() == [count / max(len(errors), 1) for count in below]
    figure = accuracy_figure({"a": np.array(errors)})
    (label,) = figure.axes[0].get_legend_handles_labels()[1]
    shown = float(label.removeprefix("a (AUC ").removesuffix(" %)"))
    exact = 100 * auc(torch.tensor(errors, dtype=torch.float64), 0.1)
    assert shown == pytest.approx(exact, abs=0.05 + 1e-9)


def test_png_and_csv_hold_the_curves(tmp_path):
    folder = tmp_path / "run.1"
    curves = {"DOPE, old": np.array([0.02, math.inf]), "DOPE++": np.array([0.0, 0.0101])}
    save_accuracy_curves(folder / "auc_curves", curves, title="servoholder")
    assert {path.name for path in folder.iterdir()} == {"auc_curves.csv", "auc_curves.png"}
    rows = read_csv(folder / "auc_curves.csv")
    assert list(rows[0]) == ["threshold_m", *curves]
    table = np.array([list(row.values()) for row in rows], float)
    np.testing.assert_allclose(table[:, 0], np.arange(201) * 0.0005, atol=1e-9)
    # Errors of 0, 10.1 and 20 mm are strictly below the thresholds after them.
    expected = {0: [0, 0], 1: [0, 0.5], 20: [0, 0.5], 21: [0, 1], 40: [0, 1], 41: [0.5, 1]}
    assert {row: table[row, 1:].tolist() for row in expected} == expected
    assert table[-1, 1:].tolist() == [0.5, 1]
    image = read_rgb(folder / "auc_curves.png")
    assert image.shape[0] > 300
    assert image.std() > 5


def test_empty_figures_are_drawn_and_pyplot_holds_no_figure():
    for curves in ({}, {"none": np.array([])}, {"a": np.array([0.01])}):
        assert figure_image(accuracy_figure(curves)).ndim == 3
    assert plt.get_fignums() == []


def curve(*rates):
    rate = np.array(rates)
    return RateCurve(np.arange(len(rates), dtype=float), rate, rate * 0.9, rate * 0.9 + 0.1)


def test_every_panel_has_a_line_and_an_interval_for_every_method():
    both = {"dope": curve(0.9, 0.5), "dopepp": curve(1.0, 0.8)}
    panels = {"a": both, "b": {"dope": curve(0.1)}, "c": {}}
    figure = rates_figure(panels, "distance (m)", 2, np.array([-0.5, 0.5]))
    first, second, third, unused = figure.axes
    assert [axes.get_title() for axes in figure.axes[:3]] == ["a", "b", "c"]
    assert [text.get_text() for text in first.get_legend().get_texts()] == ["dope", "dopepp"]
    np.testing.assert_allclose(first.get_lines()[0].get_ydata(), [90, 50])
    # The band of a single point has no width, so the point has a bar.
    (low, high) = second.collections[-1].get_segments()[0][:, 1]
    assert (low, high) == pytest.approx((9, 19))
    assert third.get_legend() is None
    assert not unused.axison
    assert figure_image(figure).std() > 0


def test_ratios_are_evenly_spaced_with_ticks_at_the_measured_values():
    rate = np.array([0.1, 0.9, 0.4])
    lines = {"dopepp": RateCurve(np.array([0.5, 1.0, 2.0]), rate, rate, rate)}
    (axes,) = rates_figure({"a": lines}, "scale", 1, ratio=True).axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["0.5", "1", "2"]
    left, middle, right = axes.transData.transform([(x, 0) for x in (0.5, 1, 2)])[:, 0]
    assert middle - left == pytest.approx(right - middle)


def test_the_list_of_fonts_is_not_reported(caplog):
    with caplog.at_level(logging.INFO):
        logging.getLogger("matplotlib.font_manager").info("generated new fontManager")
    assert not caplog.records
