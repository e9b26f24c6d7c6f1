"""Sharpness and exposure against pictures that were blurred and exposed by known amounts."""

import cv2
import numpy as np
import pytest

from dopepp.inference.diagnosis.case import clipped, edge_width, highlights


def shapes(noise: float = 0.0) -> np.ndarray:
    """Return a sharp picture of large shapes."""
    image = np.full((240, 320, 3), 60, np.uint8)
    cv2.rectangle(image, (30, 40), (140, 190), (180, 170, 90), -1)
    cv2.circle(image, (230, 120), 60, (90, 200, 220), -1)
    noisy = image + np.random.default_rng(0).normal(size=image.shape) * noise
    return np.clip(noisy, 0, 255).round().astype(np.uint8)


@pytest.mark.parametrize(
    ("sigma", "noise"), [(1.5, 0.0), (1.5, 3.0), (2.5, 3.0), (4.0, 0.0), (4.0, 3.0), (6.0, 0.0)]
)
def test_a_known_blur_is_measured(sigma, noise):
    blurred = cv2.GaussianBlur(shapes(), (0, 0), sigma).astype(float)
    blurred += np.random.default_rng(1).normal(size=blurred.shape) * noise
    width = edge_width(np.clip(blurred, 0, 255).astype(np.uint8))
    assert width == pytest.approx(sigma, rel=0.2)


@pytest.mark.parametrize("noise", [0.0, 4.0])
def test_sharp_edges_are_narrow(noise):
    assert edge_width(shapes(noise)) < 0.8


@pytest.mark.parametrize("level", [0, 90, 255])
def test_a_plain_picture_does_not_tell(level):
    assert edge_width(np.full((64, 64, 3), level, np.uint8)) is None


def test_highlights_and_white_are_shares_of_the_picture():
    image = np.full((100, 100, 3), 40, np.uint8)
    image[:20] = 255
    image[20:30] = (255, 255, 90)  # yellow has detail left
    assert clipped(image) == 0.2
    assert highlights(image) == 255
    assert highlights(image[30:]) == 40
