"""Frames without the part: their size, kinds and photos."""

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.negative_frames import LOOKALIKES, PHOTOS, SCENES, negative_frames


@pytest.fixture
def photos(tmp_path):
    """A folder of twelve different photos."""
    rng = np.random.default_rng(0)
    for number in range(12):
        noise = rng.integers(0, 256, (150, 200, 3), np.uint8)
        assert cv2.imwrite(str(tmp_path / f"{number}.png"), cv2.GaussianBlur(noise, (9, 9), 3))
    return tmp_path


def frames(config, split, count=6):
    return negative_frames(config.data, build_parts(config.data), split, count)


def test_frames_of_a_preset_are_large_and_of_each_kind_in_turn(tiny, photos):
    config = tiny(f"virtual.backgrounds={photos}")
    source = frames(config, "val")
    samples = [source.sample(index) for index in range(len(source))]
    assert [sample.source for sample in samples] == [PHOTOS, SCENES, LOOKALIKES] * 2
    preset = config.data.preset
    for index, sample in enumerate(samples):
        assert sample.size == (640, 480)
        assert not sample.instances
        # A part at the same distance covers as many pixels as in the preset.
        assert sample.K[0, 0] == preset.K[0, 0]
        np.testing.assert_allclose(sample.K[:2, 2], [319.5, 239.5])
        np.testing.assert_array_equal(source.sample(index).image, sample.image)
    others = [frames(config, "test").sample(index) for index in range(6)]
    assert not {sample.key for sample in samples[::3]} & {sample.key for sample in others[::3]}
    assert all((a.image != b.image).any() for a, b in zip(samples, others, strict=True))


def test_too_few_photos_are_refused(tiny, photos):
    for number in range(6, 12):
        (photos / f"{number}.png").unlink()
    assert len(frames(tiny(f"virtual.backgrounds={photos}"), "val")) == 6
    (photos / "0.png").unlink()
    with pytest.raises(UserError, match=r"5 photos are too few .*at least 6 different"):
        frames(tiny(f"virtual.backgrounds={photos}"), "val")
