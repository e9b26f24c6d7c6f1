"""Windows of frames: geometry, random positions and visible fractions of cut objects."""

import numpy as np
import pytest

from dopepp.data.hybrid import WindowedSource
from dopepp.data.rendered import RenderedSource
from dopepp.data.sample import Sample, crop_sample, letterbox_sample
from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory

PART = pivconnector()


@pytest.fixture(scope="module")
def frames():
    return RenderedSource(Factory([PART], PRESETS["wide"].reframed(320, 240), 1), 4)


@pytest.fixture(scope="module")
def windows(frames):
    def make(number: int, window=(96, 64), size=(160, 120)) -> list[Sample]:
        source = WindowedSource(frames, size, window, 5)
        return [source.sample(index % 4, index // 4) for index in range(number)]

    return make


def test_keypoints_follow_the_window(windows):
    for sample in windows(8):
        assert sample.size == (96, 64)
        for detection in sample.instances:
            expected = project_keypoints(PART.cuboid, detection.T_cam_obj, sample.K)
            np.testing.assert_allclose(detection.keypoints, expected, atol=1e-6)
            assert detection.mask.shape == (64, 96)


def test_a_window_is_a_crop_of_the_resized_image(frames):
    whole = letterbox_sample(frames.sample(2), (160, 120))
    window = WindowedSource(frames, (160, 120), (96, 64), 5).sample(2)
    left, top = np.round(whole.K[:2, 2] - window.K[:2, 2]).astype(int)
    np.testing.assert_array_equal(window.image, whole.image[top : top + 64, left : left + 96])
    np.testing.assert_array_equal(
        window.instances[0].mask, whole.instances[0].mask[top : top + 64, left : left + 96]
    )


def test_every_window_contains_a_centre_at_a_random_position(windows):
    shown = windows(40)
    centres = np.array([sample.instances[0].keypoints[CENTROID] for sample in shown])
    assert ((centres > -0.5) & (centres < (95.5, 63.5))).all()
    assert (centres.std(axis=0) > 8).all()
    places = {tuple(sample.K[:2, 2]) for sample in shown}
    assert len(places) > 35
    for first, other in zip(shown, windows(8), strict=False):
        np.testing.assert_array_equal(first.image, other.image)


def test_an_image_smaller_than_the_window_is_padded(windows):
    (sample,) = windows(1, window=(200, 64))
    assert (sample.size, sample.instances[0].mask.shape) == ((200, 64), (64, 200))
    assert not sample.image[:, 160:].any()
    assert sample.image[:, :160].any(axis=(0, 2)).all()


def test_without_an_object_a_window_is_anywhere():
    class Empty:
        name = "empty"

        def sample(self, index, epoch=0):
            return Sample(np.arange(160 * 120 * 3).astype(np.uint8).reshape(120, 160, 3), np.eye(3))

    source = WindowedSource(Empty(), (160, 120), (32, 32), 0)
    corners = np.array([source.sample(0, epoch).K[:2, 2] for epoch in range(400)])
    assert (-corners.max(axis=0) < 8).all()
    assert (-corners.min(axis=0) > (120, 80)).all()
    assert (-corners.min(axis=0) <= (128, 88)).all()


@pytest.mark.parametrize("has_mask", [True, False])
def test_pixels_outside_the_window_are_not_visible(has_mask, frames):
    sample = frames.sample(0)
    instance = sample.instances[0]
    if not has_mask:
        instance.mask = None
    columns = np.flatnonzero(frames.sample(0).instances[0].mask.any(axis=0))
    middle = int(columns.mean())
    halves = [
        crop_sample(sample, 0, 0, (middle, 240)),
        crop_sample(sample, middle, 0, (320 - middle, 240)),
    ]
    fractions = [half.instances[0].visible_fraction for half in halves]
    assert sum(fractions) == pytest.approx(instance.visible_fraction, abs=1e-3)
    assert min(fractions) > 0.1
    aside = crop_sample(sample, 0, 0, (2, 2)).instances[0]
    assert aside.visible_fraction == 0
