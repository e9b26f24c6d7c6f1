"""The sensor: each step against SciPy, Pillow or a closed form."""

from functools import partial

import cv2
import numpy as np
import pytest
import scipy.ndimage
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from dopepp.virtual import sensor as steps
from dopepp.virtual.sensor import Sensor, Sensors, add_noise, capture


@pytest.fixture(scope="module")
def image():
    noise = np.random.default_rng(0).integers(0, 256, (60, 90, 3), np.uint8)
    return cv2.GaussianBlur(noise, (9, 9), 2)


def test_the_default_sensor_changes_nothing(image):
    assert capture(image, Sensor()) is image


@given(
    exposure=st.floats(-8, 8),
    blur=st.floats(0, 5),
    motion=st.tuples(st.floats(-12, 12), st.floats(-12, 12)),
    read=st.floats(0, 60),
    shot=st.floats(0, 60),
    quality=st.none() | st.integers(1, 100),
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 20), st.integers(1, 20)),
)
def test_capture_is_pure_and_keeps_the_shape(
    exposure, blur, motion, read, shot, quality, seed, size
):
    image = np.random.default_rng(1).integers(0, 256, (*size, 3), np.uint8)
    before, sensor = image.copy(), Sensor(exposure, blur, motion, read, shot, quality, seed)
    first = capture(image, sensor)
    np.testing.assert_array_equal(first, capture(image, sensor))
    np.testing.assert_array_equal(image, before)
    assert (first.dtype, first.shape) == (np.uint8, image.shape)


def linear(codes):
    share = codes / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("exposure", [-2.0, -0.3, 0.5, 1.0])
def test_exposure_multiplies_the_light(exposure):
    codes = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    exposed = capture(codes, Sensor(exposure_ev=exposure))
    wanted = np.minimum(linear(codes) * 2**exposure, 1.0)
    # Half a grey level is up to 0.45 % of white in linear light.
    np.testing.assert_allclose(linear(exposed), wanted, atol=0.0046)
    assert (np.diff(exposed[0, :, 0].astype(int)) >= 0).all()


@pytest.mark.parametrize("motion", [(7.0, 0.0), (0.0, -4.5), (3.0, 2.0), (0.3, 0.1), (-6.0, 9.0)])
def test_motion_blur_is_the_mean_of_shifted_images(image, motion):
    shift = partial(scipy.ndimage.shift, image.astype(float), order=1, mode="mirror")
    shifts = [shift((t * motion[1], t * motion[0], 0)) for t in np.linspace(-0.5, 0.5, 401)]
    assert np.abs(steps.motion_blur(image, motion) - np.mean(shifts, axis=0)).max() < 2.0


@pytest.mark.parametrize(("level", "read", "shot"), [(128, 6, 0), (40, 0, 8), (200, 3, 5)])
def test_noise_has_the_stated_spread(level, read, shot):
    flat = np.full((300, 400, 3), level, np.uint8)
    noise = add_noise(flat, read, shot, 3).astype(float) - level
    # Rounding to whole levels adds a variance of 1/12.
    expected = np.sqrt(read**2 + shot**2 * level / 255 + 1 / 12)
    assert noise.std() == pytest.approx(expected, rel=0.01)
    assert abs(noise.mean()) < 4 * expected / np.sqrt(noise.size)
    assert abs(scipy.stats.kurtosis(noise.reshape(-1))) < 0.05
    assert abs(scipy.stats.skew(noise.reshape(-1))) < 0.03


def test_noise_is_independent_of_place_channel_and_seed():
    flat = np.full((300, 400, 3), 128, np.uint8)
    noise = add_noise(flat, 8, 0, 3).astype(float) - 128
    other = add_noise(flat, 8, 0, 4).astype(float) - 128
    pairs = [
        (noise, other), (noise[1:], noise[:-1]), (noise[:, 1:], noise[:, :-1]),
        (noise[..., 0], noise[..., 1]), (noise[..., 0], noise[..., 2]),
    ]  # fmt: skip
    for a, b in pairs:
        assert abs(np.corrcoef(a.reshape(-1), b.reshape(-1))[0, 1]) < 0.015


def test_drawn_sensors_keep_to_their_ranges():
    ranges, rng = Sensors(), np.random.default_rng(0)
    drawn = [ranges.draw(rng) for _ in range(2000)]
    for sensor in drawn:
        assert ranges.exposure_ev[0] <= sensor.exposure_ev <= ranges.exposure_ev[1]
        assert sensor.blur_px == 0 or ranges.blur_px[0] <= sensor.blur_px <= ranges.blur_px[1]
        length = float(np.hypot(*sensor.motion_px))
        low, high = ranges.motion_px
        assert length == 0 or low - 1e-9 <= length <= high + 1e-9
        assert sensor.jpeg_quality is None or 70 <= sensor.jpeg_quality <= 95
    assert np.mean([s.blur_px > 0 for s in drawn]) == pytest.approx(0.2, abs=0.03)
    assert np.mean([s.read_noise > 0 for s in drawn]) == pytest.approx(0.5, abs=0.04)
    assert len({s.noise_seed for s in drawn}) > 1990


def test_probabilities_of_zero_give_the_default_sensor():
    names = ("exposure", "blur", "motion", "noise", "jpeg")
    off = Sensors(**{f"{name}_probability": 0 for name in names})
    drawn = off.draw(np.random.default_rng(1))
    assert drawn == Sensor(noise_seed=drawn.noise_seed)
