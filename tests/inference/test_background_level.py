"""The level of verification that a pose must exceed, measured on photos without the part."""

import math
from pathlib import Path

import numpy as np
import pytest

from dopepp.inference.templates import background_level
from dopepp.parts.catalogue import pivconnector

DISTANCES = (0.2, 0.3)


@pytest.fixture
def measured(monkeypatch, tmp_path):
    """Use an empty cache folder, and return the images that are measured."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return []


def level_of(measured, values, part=None, distances=DISTANCES, tilt=180.0):
    def measure(images, K):
        shown = list(images)
        measured.extend((image, K) for image in shown)
        return [values[number % len(values)] for number in range(len(shown))]

    return background_level.background_log_odds(part or pivconnector(), distances, tilt, measure)


def test_level_is_mean_and_deviations_of_different_photos(measured):
    values = list(np.random.default_rng(0).normal(2.0, 0.5, background_level.NUM_PHOTOS))
    level = level_of(measured, values)
    assert level == pytest.approx(np.mean(values) + background_level.MARGIN * np.std(values))
    images = [image for image, _ in measured]
    assert len(images) == background_level.NUM_PHOTOS
    assert {image.shape for image in images} == {(*background_level.SIZE[::-1], 3)}
    assert len({image.tobytes() for image in images}) == background_level.NUM_PHOTOS
    focal = measured[0][1][0, 0]
    shown = focal * pivconnector().diameter / math.sqrt(0.2 * 0.3)
    assert shown == pytest.approx(background_level.PART_PX)


def test_level_is_measured_once_for_a_part_and_its_options(measured):
    first = level_of(measured, [1.0])
    assert level_of(measured, [5.0]) == first
    assert len(measured) == background_level.NUM_PHOTOS
    assert level_of(measured, [5.0], distances=(0.2, 0.4)) == 5.0
    assert level_of(measured, [6.0], tilt=60.0) == 6.0


def test_level_is_never_below_even_odds(measured):
    assert level_of(measured, [-3.0]) == background_level.LOWEST


@pytest.mark.parametrize("damage", [b"", b"{", b'"high"', b"[1.0]"])
def test_damaged_file_is_measured_again(measured, tmp_path, damage):
    level_of(measured, [1.0])
    (path,) = Path(tmp_path, "dopepp", "templates").iterdir()
    path.write_bytes(damage)
    assert level_of(measured, [2.0]) == 2.0
    assert level_of(measured, [3.0]) == 2.0
