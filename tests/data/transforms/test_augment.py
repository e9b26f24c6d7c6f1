from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.data.transforms.augment import Photometric

STRENGTHS = ("brightness", "contrast", "saturation", "hue", "colour_gain")
OFF = dict.fromkeys([*STRENGTHS, *(f"{name}_probability" for name in ("blur", "noise", "jpeg"))], 0)


@pytest.fixture(scope="module")
def image():
    noise = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    return cv2.GaussianBlur(noise, (5, 5), 2)


def only(**options: Any) -> Photometric:
    return Photometric(**(OFF | options))


@given(seed=st.integers(0, 2**31), epoch=st.integers(0, 100))
def test_pure_function_of_the_generator(seed, epoch):
    image = np.random.default_rng(1).integers(0, 256, (20, 30, 3), np.uint8)
    before, augment = image.copy(), Photometric()
    first = augment(image, np.random.default_rng([seed, epoch]))
    second = augment(image, np.random.default_rng([seed, epoch]))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(image, before)
    assert (first.dtype, first.shape) == (image.dtype, image.shape)


def test_zero_ranges_change_nothing(image):
    np.testing.assert_array_equal(only()(image, np.random.default_rng(0)), image)


def test_brightness_and_contrast_stay_in_their_range():
    def mean(augment, level, seed):
        grey = np.full((8, 8, 3), level, np.uint8)
        return float(augment(grey, np.random.default_rng(seed)).mean())

    brightness, contrast = only(brightness=0.2), only(contrast=0.3)
    offsets = [mean(brightness, 128, seed) - 128 for seed in range(200)]
    gains = [(mean(contrast, 160, s) - mean(contrast, 90, s)) / 70 for s in range(200)]
    assert -0.2 * 255 - 0.5 <= min(offsets) < -40
    assert 40 < max(offsets) <= 0.2 * 255 + 0.5
    assert 0.68 < min(gains) < 0.8
    assert 1.2 < max(gains) < 1.32


def test_hue_and_saturation_keep_the_luma(image):
    soft = (image // 2 + 64).astype(np.uint8)  # away from clipping
    changed = only(hue=0.5, saturation=0.3)(soft, np.random.default_rng(2))
    assert np.abs(changed.astype(int) - soft).max() > 3
    luma = [cv2.cvtColor(array, cv2.COLOR_RGB2GRAY).astype(int) for array in (soft, changed)]
    assert np.abs(luma[0] - luma[1]).max() <= 2
    grey = np.full((4, 4, 3), 77, np.uint8)
    np.testing.assert_allclose(only(hue=1.0, saturation=0.5)(grey, np.random.default_rng(0)), 77)


def test_noise_has_the_given_standard_deviation():
    grey = np.full((200, 200, 3), 128, np.uint8)
    augment = only(noise_probability=1, noise_sigma=(6.0, 6.0))
    noise = augment(grey, np.random.default_rng(0)).astype(float) - 128
    assert noise.std() == pytest.approx(6.0, rel=0.02)
    assert abs(noise.mean()) < 0.1
    for value in (0, 255):
        flat = np.full((20, 20, 3), value, np.uint8)
        assert np.abs(augment(flat, np.random.default_rng(0)).astype(int) - value).max() < 40


def test_blur_and_jpeg_against_opencv(image):
    blurred = only(blur_probability=1, blur_sigma=(1.0, 1.0))(image, np.random.default_rng(0))
    np.testing.assert_array_equal(blurred, cv2.GaussianBlur(image, (0, 0), 1.0))
    mild = only(jpeg_probability=1, jpeg_quality=(95, 95))(image, np.random.default_rng(0))
    harsh = only(jpeg_probability=1, jpeg_quality=(10, 10))(image, np.random.default_rng(0))
    errors = [np.abs(array.astype(int) - image).mean() for array in (mild, harsh)]
    assert 0 < errors[0] < errors[1]
