"""Division of photos between training, validation and test."""

import re
import shutil
from itertools import chain

import cv2
import numpy as np
import pytest

from dopepp.drawing.pictures import read_picture
from dopepp.virtual.backgrounds import (
    MixedBackgrounds,
    PhotoBackgrounds,
    ProceduralBackgrounds,
    shipped_photos,
)

SPLITS = ("train", "val", "test")


def write_numbers(folder, numbers):
    """Write files that differ; the division does not decode them."""
    folder.mkdir(exist_ok=True)
    for number in numbers:
        (folder / f"{number}.jpg").write_bytes(f"photo {number}".encode())
    return PhotoBackgrounds(folder)


def contents(photos):
    return [sorted(path.read_bytes() for path in photos.part(split).paths) for split in SPLITS]


@pytest.mark.parametrize(
    ("count", "expected"), [(6, [2, 2, 2]), (7, [3, 2, 2]), (20, [14, 3, 3]), (100, [70, 15, 15])]
)
def test_splits_are_disjoint_and_complete(tmp_path, count, expected):
    photos = write_numbers(tmp_path, range(count))
    splits = contents(photos)
    assert [len(split) for split in splits] == expected
    assert sorted(chain(*splits)) == sorted(path.read_bytes() for path in photos.paths)
    assert all(photos.part(split).is_divided for split in SPLITS)
    assert photos.part("all") is photos
    assert not photos.is_divided


def test_splits_do_not_depend_on_names_and_folders(tmp_path):
    photos = write_numbers(tmp_path / "a", range(20))
    splits = contents(photos)
    (tmp_path / "b" / "deeper").mkdir(parents=True)
    for number, path in enumerate(reversed(photos.paths)):
        shutil.copy(path, tmp_path / "b" / "deeper" / f"renamed{number}.png")
    assert contents(PhotoBackgrounds(tmp_path / "b")) == splits


def test_copies_stay_together_and_do_not_count_as_photos(tmp_path):
    photos = write_numbers(tmp_path, range(5))
    for number in range(5):
        shutil.copy(tmp_path / f"{number}.jpg", tmp_path / f"copy{number}.jpg")
    assert not PhotoBackgrounds(tmp_path).part("val").is_divided  # ten files, five photos
    photos = write_numbers(tmp_path, range(6))
    splits = [set(split) for split in contents(photos)]
    assert [len(split) for split in splits] == [2, 2, 2]
    assert not set.intersection(*splits)


def test_a_new_photo_moves_few_photos_to_another_split(tmp_path):
    before = contents(write_numbers(tmp_path, range(100)))
    after = contents(write_numbers(tmp_path, range(101)))
    moved = sum(len(set(a) - set(b)) for a, b in zip(before, after, strict=True))
    assert moved <= 2  # at the two borders of the order of hashes


def test_the_photos_of_a_folder_are_read_once(tmp_path):
    photos = write_numbers(tmp_path, range(20))
    names = [path.name for path in photos.paths]
    train = photos.part("train")
    for path in photos.paths:
        path.unlink()
    val, test = (PhotoBackgrounds(tmp_path, names).part(split) for split in ("val", "test"))
    assert sorted([*train.paths, *val.paths, *test.paths]) == photos.paths


def test_the_identity_names_the_split(tmp_path):
    photos = write_numbers(tmp_path, range(20))
    identities = {tuple(photos.part(split).identity()) for split in (*SPLITS, "all")}
    assert len(identities) == 4
    assert photos.part("val").identity()[:2] == ["val photos", "3"]
    for path in photos.paths[5:]:
        path.unlink()
    few = PhotoBackgrounds(tmp_path)
    assert few.part("train").identity() == few.part("test").identity() == few.identity()


def test_a_split_draws_its_photos_only(tmp_path):
    for number in range(12):
        colour = np.full((40, 60, 3), 20 * number, np.uint8)
        assert cv2.imwrite(str(tmp_path / f"{number}.png"), colour)
    photos = PhotoBackgrounds(tmp_path)
    shown = []
    for split in SPLITS:
        part = photos.part(split)
        shades = {read_picture(path).max() for path in part.paths}
        rng = np.random.default_rng(0)
        frames = [part.frame(rng, number, (64, 48))[0] for number in range(len(part.paths))]
        assert {frame.max() for frame in frames} == shades
        shown.append(shades)
    assert not set.intersection(*shown)


def test_a_photo_of_one_pixel_has_frames(tmp_path):
    assert cv2.imwrite(str(tmp_path / "dot.png"), np.full((1, 1, 3), 80, np.uint8))
    frame, _ = PhotoBackgrounds(tmp_path).frame(np.random.default_rng(0), 0, (64, 48), 0.5)
    assert frame.shape == (48, 64, 3)
    assert (frame == 80).all()


def test_mixed_backgrounds_draw_a_share_from_the_others(tmp_path):
    assert cv2.imwrite(str(tmp_path / "white.png"), np.full((40, 60, 3), 255, np.uint8))
    mixed = MixedBackgrounds(ProceduralBackgrounds(), PhotoBackgrounds(tmp_path), 0.25)
    images = [mixed.draw(np.random.default_rng(seed), 32, 24) for seed in range(400)]
    share = np.mean([np.ptp(image) == 0 for image in images])
    assert share == pytest.approx(0.25, abs=0.06)
    again = mixed.draw(np.random.default_rng(7), 32, 24)
    np.testing.assert_array_equal(again, images[7])
    other = MixedBackgrounds(ProceduralBackgrounds(), PhotoBackgrounds(tmp_path), 0.5)
    assert mixed.identity() != other.identity()


def test_shipped_photos_are_of_one_size_and_each_has_its_licence():
    halves = [shipped_photos("val"), shipped_photos("test")]
    names = [{path.name for path in half.paths} for half in halves]
    assert [len(half) for half in names] == [12, 12]
    assert not names[0] & names[1]
    paths = sorted(path for half in halves for path in half.paths)
    assert sum(path.stat().st_size for path in paths) < 1_500_000
    assert {read_picture(path).shape for path in paths} == {(480, 640, 3)}
    notice = (paths[0].parent / "NOTICE.md").read_text()
    rows = re.findall(r"^\| `(.+\.jpg)` \| .+ \| (CC0|public domain) \|$", notice, re.MULTILINE)
    assert sorted(name for name, _ in rows) == [path.name for path in paths]
