"""Curves and PNG files: the numbers in them, and that a file is whole or absent."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dopepp.core.files import write_png, write_whole
from dopepp.drawing.curves import (
    accuracy_curve,
    accuracy_figure,
    figure_image,
    save_accuracy_curves,
)
from dopepp.metrics.functional import auc

ERRORS = st.lists(
    st.one_of(st.floats(0, 0.2), st.sampled_from([0.0, 0.05, math.inf, math.nan])), max_size=20
)


@given(ERRORS)
@settings(deadline=None, max_examples=60)
def test_a_curve_counts_what_is_strictly_below(errors: list[float]) -> None:
    thresholds, accuracy = accuracy_curve(np.array(errors))
    for threshold, share in zip(thresholds, accuracy, strict=True):
        below = sum(error < threshold for error in errors)
        assert share == below / max(len(errors), 1)


@given(ERRORS)
@settings(deadline=None, max_examples=20)
def test_the_legend_shows_the_exact_auc_of_metrics(errors: list[float]) -> None:
    figure = accuracy_figure({"a": np.array(errors)})
    label = figure.axes[0].get_legend_handles_labels()[1][0]
    shown = float(label.removeprefix("a (AUC ").removesuffix(" %)"))
    exact = 100 * auc(torch.tensor(errors, dtype=torch.float64), 0.1)
    assert shown == pytest.approx(exact, abs=0.05 + 1e-9)


def test_png_and_csv_hold_the_curves(tmp_path: Path) -> None:
    curves = {"DOPE, old": np.array([0.02, math.inf]), "DOPE++": np.array([0.0, 0.0101])}
    save_accuracy_curves(tmp_path / "run.1" / "auc_curves", curves, title="servoholder")
    with (tmp_path / "run.1" / "auc_curves.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["threshold_m", "DOPE, old", "DOPE++"]
    table = np.array(rows[1:], float)
    assert table.shape == (201, 3)
    np.testing.assert_allclose(table[:, 0], np.arange(201) * 0.0005, atol=1e-9)
    at = {round(row[0], 4): row[1:].tolist() for row in table}
    assert at[0.0] == [0, 0]
    assert at[0.0005] == [0, 0.5]
    assert at[0.01] == [0, 0.5]
    assert at[0.0105] == [0, 1]
    assert at[0.02] == [0, 1]  # strictly below
    assert at[0.0205] == [0.5, 1]
    assert at[0.1] == [0.5, 1]
    image = cv2.imread(str(tmp_path / "run.1" / "auc_curves.png"))
    assert image.shape[0] > 300
    assert image.std() > 5
    assert sorted(p.name for p in (tmp_path / "run.1").iterdir()) == [
        "auc_curves.csv",
        "auc_curves.png",
    ]


def test_figures_without_curves_are_drawn() -> None:
    assert figure_image(accuracy_figure({})).ndim == 3
    assert figure_image(accuracy_figure({"none": np.array([])})).ndim == 3


def test_no_global_state_of_pyplot_is_touched() -> None:
    import matplotlib.pyplot as plt

    figure_image(accuracy_figure({"a": np.array([0.01])}))
    assert plt.get_fignums() == []


def test_a_png_keeps_its_pixels_in_rgb(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    write_png(tmp_path / "new" / "image.png", image)
    back = cv2.imread(str(tmp_path / "new" / "image.png"))[..., ::-1]
    assert np.array_equal(back, image)


@pytest.mark.parametrize(
    "image", [np.zeros((2, 2, 3)), np.zeros((2, 2), np.uint8), np.zeros((0, 2, 3), np.uint8)]
)
def test_what_is_no_image_is_refused(image: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"an image must be uint8 \(H, W, 3\), got"):
        write_png(tmp_path / "image.png", image)
    assert list(tmp_path.iterdir()) == []


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.csv"
    write_whole(path, b"old")

    def full(*_: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
