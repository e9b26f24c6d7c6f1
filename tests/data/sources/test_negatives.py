"""Sources of frames without objects."""

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data.negatives import FrameMix, PhotoFrames
from dopepp.geometry.camera import camera_matrix
from dopepp.virtual.backgrounds import PhotoBackgrounds


def write_noise(path):
    rng = np.random.default_rng(int(path.stem))
    assert cv2.imwrite(str(path), rng.integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8))


K = camera_matrix(100.0, 100.0, 31.5, 23.5)
SIZE = 64, 48


@pytest.fixture
def folder(tmp_path):
    """Images of the camera's size, as PNG."""
    for number in range(4):
        write_noise(tmp_path / f"{number}.png")
    return tmp_path


def test_images_of_the_camera_are_unchanged(folder):
    source = PhotoFrames(PhotoBackgrounds(folder), K, SIZE, name="desk")
    assert len(source) == 4
    samples = [source.sample(index) for index in range(4)]
    assert sorted(sample.key for sample in samples) == [f"{number}.png/0" for number in range(4)]
    for sample in samples:
        photo = cv2.imread(str(folder / sample.key.rpartition("/")[0]))[..., ::-1]
        np.testing.assert_array_equal(sample.image, photo)
        np.testing.assert_array_equal(sample.K, K)
        assert (sample.source, sample.instances, sample.depth) == ("desk", [], None)


def test_the_second_round_is_mirrored_and_further_rounds_show_regions(folder):
    source = PhotoFrames(PhotoBackgrounds(folder), K, SIZE, num_frames=12)
    for index in range(4):
        whole, mirrored, region = (source.sample(index + 4 * lap) for lap in range(3))
        np.testing.assert_array_equal(mirrored.image, whole.image[:, ::-1])
        assert region.image.shape == whole.image.shape
        assert (region.image != whole.image).any()
        np.testing.assert_array_equal(source.sample(index + 8).image, region.image)


def test_a_larger_image_is_cropped_at_its_centre(tmp_path):
    # The colour of a pixel encodes its position.
    y, x = np.mgrid[0:480, 0:800]
    photo = np.stack([x / 4, y / 4, 0 * x], axis=2).astype(np.uint8)
    assert cv2.imwrite(str(tmp_path / "wide.png"), photo[..., ::-1])
    image = PhotoFrames(PhotoBackgrounds(tmp_path), K, SIZE).sample(0).image.astype(float)
    # At the frame's aspect ratio of 4:3, 480 rows have 640 columns, from column 80 on.
    np.testing.assert_allclose(image[0, 0, :2], (20, 0), atol=2)
    np.testing.assert_allclose(image[-1, -1, :2], (180, 120), atol=2)


def test_damaged_images_are_replaced_up_to_a_limit(tmp_path):
    def keys():
        source = PhotoFrames(PhotoBackgrounds(tmp_path), K, SIZE)
        return {source.sample(index).key for index in range(120)}

    for number in range(120):
        write_noise(tmp_path / f"{number:03}.png")
    (tmp_path / "050.png").write_bytes(b"no image")
    assert len(keys() - {"050.png/0"}) == len(keys()) == 119
    (tmp_path / "051.png").write_bytes(b"no image")
    with pytest.raises(UserError, match="2 damaged of 120"):
        keys()


def test_the_index_selects_the_source(folder):
    photos = PhotoBackgrounds(folder)
    sources = [PhotoFrames(photos, K, SIZE, name=name) for name in "abc"]
    mix = FrameMix(sources, 10)
    assert "".join(mix.sample(index).source for index in range(len(mix))) == "abcabcabca"
    np.testing.assert_array_equal(mix.sample(4).image, sources[1].sample(1).image)
