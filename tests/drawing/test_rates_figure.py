from __future__ import annotations

import numpy as np
import pytest

from dopepp.drawing.curves import RateCurve, figure_image, rates_figure


def curve(*rates: float) -> RateCurve:
    rate = np.array(rates)
    return RateCurve(np.arange(len(rates), dtype=float), rate, rate * 0.9, rate * 0.9 + 0.1)


def test_every_panel_has_a_line_and_an_interval_for_every_method() -> None:
    panels = {
        "a": {"dope": curve(0.9, 0.5), "dopepp": curve(1.0, 0.8)},
        "b": {"dope": curve(0.1)},
        "c": {},
    }
    figure = rates_figure(panels, "distance (m)", 2, np.array([-0.5, 0.5]))
    first, second, third, unused = figure.axes
    assert [axes.get_title() for axes in figure.axes[:3]] == ["a", "b", "c"]
    assert [text.get_text() for text in first.get_legend().get_texts()] == ["dope", "dopepp"]
    np.testing.assert_allclose(first.get_lines()[0].get_ydata(), [90, 50])
    # A point on its own has a bar, because its band has no width.
    (low, high) = second.collections[-1].get_segments()[0][:, 1]
    assert (low, high) == pytest.approx((9, 19))
    assert third.get_legend() is None
    assert not unused.axison
    assert figure_image(figure).std() > 0


def test_ratios_are_evenly_spaced_and_marked_where_they_were_measured() -> None:
    rate = np.array([0.1, 0.9, 0.4])
    lines = {"dopepp": RateCurve(np.array([0.5, 1.0, 2.0]), rate, rate, rate)}
    (axes,) = rates_figure({"a": lines}, "scale", 1, ratio=True).axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["0.5", "1", "2"]
    left, middle, right = axes.transData.transform([(x, 0) for x in (0.5, 1, 2)])[:, 0]
    assert middle - left == pytest.approx(right - middle)


@pytest.mark.parametrize(("panels", "columns"), [({}, 2), ({"a": {}}, 0)])
def test_nothing_to_draw_is_refused(panels: dict[str, dict[str, RateCurve]], columns: int) -> None:
    with pytest.raises(ValueError, match=f"got {len(panels)} and {columns}"):
        rates_figure(panels, "x", columns)
