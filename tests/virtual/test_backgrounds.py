import importlib.util
import logging
import os
import pickle

import cv2
import numpy as np
import pytest
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import read_picture
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import Factory
from dopepp.virtual.backgrounds import (
    PhotoBackgrounds,
    ProceduralBackgrounds,
    find_backgrounds,
)
from dopepp.virtual.backgrounds.procedural import ClutteredBackgrounds
from dopepp.virtual.presets import Preset, preset_of


def write_photos(folder, count, side=40):
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for number in range(count):
        noise = rng.integers(0, 256, (side, side + 20, 3), np.uint8)
        assert cv2.imwrite(str(folder / f"{number:04}.jpg"), cv2.GaussianBlur(noise, (9, 9), 3))


def draw(backgrounds, seed):
    return backgrounds.draw(np.random.default_rng(seed), 32, 24)


def test_a_choice_by_name(tmp_path):
    assert isinstance(find_backgrounds(None), ProceduralBackgrounds)
    assert find_backgrounds("procedural").identity() == ["procedural"]
    for folder in ("nowhere", tmp_path):
        with pytest.raises(UserError, match="no photo in the folder"):
            find_backgrounds(folder)


def test_bundled_photos_need_no_download(monkeypatch):
    pytest.importorskip("skimage")
    backgrounds = find_backgrounds("skimage")
    assert isinstance(backgrounds, PhotoBackgrounds)
    assert len(backgrounds.paths) >= 5
    assert draw(backgrounds, 1).std() > 5
    for path in backgrounds.paths:
        assert min(read_picture(path).shape[:2]) >= 200
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"backgrounds=skimage without .*pip install scikit-image"):
        find_backgrounds("skimage")


def test_a_deep_tree_is_opened_without_decoding(tmp_path):
    photos = ["VOC2007/JPEGImages/a.jpg", "VOC2007/JPEGImages/b.JPG", "a.png", "z/y/x/w.webp"]
    for place in (*photos, "notes.txt", "._a.jpg", ".cache/c.jpg"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_bytes(b"never read")
    (tmp_path / "folder.jpg").mkdir()
    (tmp_path / "loop").symlink_to(tmp_path)
    os.mkfifo(tmp_path / "pipe.jpg")
    paths = PhotoBackgrounds(tmp_path).paths
    assert [path.relative_to(tmp_path).as_posix() for path in paths] == photos


def test_the_identity_depends_on_names_and_sizes_but_not_on_the_folder(tmp_path):
    write_photos(tmp_path / "a", 3)
    write_photos(tmp_path / "b", 3)
    first, again = (PhotoBackgrounds(tmp_path / name).identity() for name in "ab")
    assert (first, first[:2]) == (again, ["photos", "3"])
    (tmp_path / "b" / "0001.jpg").rename(tmp_path / "b" / "new.jpg")
    renamed = PhotoBackgrounds(tmp_path / "b").identity()
    (tmp_path / "b" / "new.jpg").write_bytes(b"longer or shorter")
    resized = PhotoBackgrounds(tmp_path / "b").identity()
    assert len({tuple(identity) for identity in (first, renamed, resized)}) == 3


@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp", "webp"])
def test_half_a_photo_is_damaged(tmp_path, suffix):
    write_photos(tmp_path / "whole", 1, 200)
    path = tmp_path / f"photo.{suffix}"
    Image.open(tmp_path / "whole" / "0000.jpg").save(path)
    content = path.read_bytes()
    for share in (0.0, 0.1, 0.5, 0.9):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(ValueError, match=r"\w"):
            read_picture(path)
    message = rf"1 damaged of 2 background photos \(.*photo\.{suffix}: .*\).*; .* at most 0 damaged"
    backgrounds = PhotoBackgrounds(tmp_path)
    with pytest.raises(UserError, match=message) as caught:
        [draw(backgrounds, seed) for seed in range(20)]
    assert "\n" not in str(caught.value)


def test_one_damaged_photo_of_many_is_replaced_independently_of_earlier_draws(tmp_path, caplog):
    write_photos(tmp_path, 200)
    bad = tmp_path / "0100.jpg"
    bad.write_bytes(bad.read_bytes()[:200])
    backgrounds = PhotoBackgrounds(tmp_path)
    with caplog.at_level(logging.WARNING):
        images = [draw(backgrounds, seed) for seed in range(400)]
    assert list(backgrounds.bad) == [bad]
    (message,) = caplog.messages
    for text in ("skipping the damaged background photo", "0100.jpg", "1 of at most 2"):
        assert text in message
    hits = [s for s in range(400) if int(np.random.default_rng(s).integers(200)) == 100]
    assert hits  # these drew the damaged photo first
    for seed in [*hits, 0]:
        np.testing.assert_array_equal(draw(PhotoBackgrounds(tmp_path), seed), images[seed])


@pytest.mark.parametrize(("count", "allowed"), [(99, 0), (100, 1), (1500, 10)])
def test_damage_is_capped(tmp_path, count, allowed):
    for number in range(count):
        (tmp_path / f"{number}.jpg").write_bytes(b"")
    backgrounds = PhotoBackgrounds(tmp_path)
    (tmp_path / "0.jpg").unlink()  # one that vanishes counts as damaged
    message = rf"^got {allowed + 1} damaged of {count} .* at most {allowed} dam"
    with pytest.raises(UserError, match=message):
        draw(backgrounds, 0)


def test_large_photos_are_reduced_like_opencv(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (1200, 1600, 3), np.uint8)
    photo = cv2.GaussianBlur(noise, (0, 0), 20)
    expected = cv2.resize(photo, (400, 300), interpolation=cv2.INTER_AREA)
    for name, tolerance, options in (("a.png", 1, {}), ("a.jpg", 6, {"quality": 95})):
        Image.fromarray(photo).save(tmp_path / name, **options)
        reduced = read_picture(tmp_path / name, 400).astype(int)
        np.testing.assert_allclose(reduced, expected.astype(int), atol=tolerance)


def test_pickling_leaves_the_decoded_photos_behind(tmp_path):
    write_photos(tmp_path, 3, 400)
    backgrounds = PhotoBackgrounds(tmp_path)
    images = [draw(backgrounds, seed) for seed in range(9)]
    packed = pickle.dumps(backgrounds)
    assert len(packed) < 5000
    copy = pickle.loads(packed)
    np.testing.assert_array_equal([draw(copy, seed) for seed in range(9)], images)


def test_memory_for_photos_is_bounded(tmp_path, monkeypatch):
    write_photos(tmp_path, 9, 100)
    limit = "dopepp.virtual.backgrounds.photo_backgrounds._KEPT_BYTES"
    monkeypatch.setattr(limit, 3 * (100 * 120 + 50 * 60) * 3)
    backgrounds = PhotoBackgrounds(tmp_path)
    for seed in range(50):
        draw(backgrounds, seed)
    assert len(backgrounds._photos) == 3


def test_crops_lie_inside_of_their_photo(tmp_path):
    # Colours ramp over the photo, so a crop's corners show its position.
    x, y = np.meshgrid(np.linspace(0, 200, 300), np.linspace(0, 200, 200))
    Image.fromarray(np.stack([x, y, 0 * x], axis=2).astype(np.uint8)).save(tmp_path / "a.png")
    backgrounds = PhotoBackgrounds(tmp_path)
    spans, mirrored = [], set()
    for seed in range(60):
        image = draw(backgrounds, seed).astype(float)
        spans.append(np.ptp(image[..., 1]) / np.ptp(image[..., 0]))
        assert (image[..., 2] == 0).all()  # RGB, as it was stored
        mirrored.add(bool(image[0, 0, 0] > image[0, -1, 0]))
        assert image[0, 0, 1] <= image[-1, 0, 1]  # never upside down
    assert mirrored == {False, True}
    # 24 rows of 200 / 200 against 32 columns of 200 / 300: a crop keeps the pixels square.
    np.testing.assert_allclose(spans, 24 / 32 * 1.5, rtol=0.1)


@pytest.mark.parametrize("size", [(640, 480), (97, 301), (33, 20), (7, 5), (1, 1)])
def test_procedural_images_depend_on_the_generator_only(size):
    first, other = ProceduralBackgrounds(), ProceduralBackgrounds()
    images = [first.draw(np.random.default_rng(seed), *size) for seed in range(8)]
    again = [other.draw(np.random.default_rng(seed), *size) for seed in reversed(range(8))]
    assert images[0].shape == (size[1], size[0], 3)
    np.testing.assert_array_equal(again[::-1], images)


def test_procedural_images_have_detail_at_every_size():
    backgrounds = ProceduralBackgrounds()
    for size in ((320, 240), (128, 128)):
        images = [backgrounds.draw(np.random.default_rng(seed), *size) for seed in range(60)]
        grey = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images)
        assert np.median([cv2.Laplacian(image, cv2.CV_32F).std() for image in grey]) > 4
        assert np.median([image.std() for image in images]) > 15
        means = np.array([image.mean(axis=(0, 1)) for image in images])
        assert means.std(axis=0).min() > 20


class Grey:
    def draw(self, rng, width, height):
        return np.full((height, width, 3), 77, np.uint8)

    def identity(self):
        return ["grey"]


def covered(number, seed, size=(96, 64)):
    clutter = ClutteredBackgrounds(Grey(), (number, number))
    image = clutter.draw(np.random.default_rng(seed), *size)
    assert (image.shape, image.dtype) == ((size[1], size[0], 3), np.uint8)
    return float((image != 77).any(axis=2).mean())


def test_a_small_piece_of_a_large_photo_is_that_photo_reduced(tmp_path, monkeypatch):
    x, y = np.meshgrid(np.linspace(0, 9, 800), np.linspace(0, 6, 500))
    waves = 127 + 60 * np.stack([np.sin(x), np.cos(x + y), np.sin(y)], axis=2)
    assert cv2.imwrite(str(tmp_path / "waves.png"), waves)
    reductions, resize = [], cv2.resize

    def reduce(image, size, **options):
        reductions.append(image.shape[1] / size[0])
        return resize(image, size, **options)

    for width in (16, 32, 64, 200, 400):
        backgrounds, whole = PhotoBackgrounds(tmp_path), PhotoBackgrounds(tmp_path)
        backgrounds.draw(np.random.default_rng(0), width, width)  # reads and halves the photo
        whole._photos.update((path, sizes[:1]) for path, sizes in backgrounds._photos.items())
        with monkeypatch.context() as patched:
            patched.setattr(cv2, "resize", reduce)
            for seed in range(5):
                image, slow = (
                    each.draw(np.random.default_rng(seed), width, width).astype(float)
                    for each in (backgrounds, whole)
                )
                assert np.abs(image - slow).mean() < 3  # the crops begin within some pixels
    fast, slow = reductions[::2], reductions[1::2]
    assert max(fast) < 4 < max(slow)


def test_more_pieces_cover_more_of_the_image():
    few, many = ([covered(number, seed) for seed in range(40)] for number in (5, 40))
    assert 0.02 < np.mean(few) < np.mean(many) < 0.9
    assert covered(0, 1) == 0


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (200, 3), (640, 480)])
def test_clutter_depends_on_the_generator_only_and_keeps_uncovered_pixels(size):
    behind = ProceduralBackgrounds()
    clutter = ClutteredBackgrounds(behind, (30, 30))
    for seed in range(4):
        image, again = (clutter.draw(np.random.default_rng(seed), *size) for _ in range(2))
        np.testing.assert_array_equal(image, again)
        plain = behind.draw(np.random.default_rng(seed), *size)
        assert min(size) < 4 or 0.05 < (image == plain).all(axis=2).mean() < 0.98


def test_a_backgrounds_contrast_is_changed_about_its_mean():
    behind = ProceduralBackgrounds()
    for seed in range(6):
        plain = behind.draw(np.random.default_rng(seed), 96, 64).astype(float)
        for factor in (0.0, 0.5, 3.0):
            changed = ClutteredBackgrounds(behind, (0, 0), (factor, factor))
            image = changed.draw(np.random.default_rng(seed), 96, 64)
            expected = np.clip(plain.mean() + factor * (plain - plain.mean()), 0, 255)
            assert image.dtype == np.uint8
            np.testing.assert_allclose(image, expected, atol=0.51)


def test_a_clutter_of_zero_changes_nothing():
    def render(clutter):
        preset = preset_of("quickstart", {"clutter": clutter})
        return Factory([pivconnector()], preset, 3).render(0, 0)

    plain, some = render([0, 0]), render([20, 20])
    reference = Factory([pivconnector()], preset_of("quickstart", {}), 3).render(0, 0)
    np.testing.assert_array_equal(plain.image, reference.image)
    assert (some.image != plain.image).any(axis=2).mean() > 0.1
    with pytest.raises(UserError, match="clutter"):
        Preset("bad", 64, 64, clutter=(-1, 3))
