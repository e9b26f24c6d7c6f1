"""Files that are complete or absent."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.core.files import IMAGES, check_target, read_limited, write_file, write_image, write_png


def test_a_png_keeps_its_pixels_in_rgb(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    write_png(tmp_path / "new" / "image.png", image)
    back = cv2.imread(str(tmp_path / "new" / "image.png"))[..., ::-1]
    assert np.array_equal(back, image)


@pytest.mark.parametrize(
    "image", [np.zeros((2, 2, 3)), np.zeros((2, 2, 4), np.uint8), np.zeros((0, 2, 3), np.uint8)]
)
def test_arrays_that_are_no_image_are_refused(image, tmp_path):
    with pytest.raises(ValueError, match=r"an image must be unsigned integers of shape"):
        write_png(tmp_path / "image.png", image)
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_read_up_to_a_limit(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"12345")
    assert read_limited(path, 5) == b"12345"
    for large in (path, Path("/dev/zero")):  # an endless file states no size
        with pytest.raises(ValueError, match="more than 4e-06 MB"):
            read_limited(large, 4)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    write_file(path, b"old")

    def full(*_: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        write_file(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("name", "head"), [("a.png", b"\x89PNG"), ("b.JPG", b"\xff\xd8")])
def test_the_suffix_determines_the_format_of_an_image(name, head, tmp_path):
    check_target(tmp_path / "new" / name, IMAGES)
    assert list((tmp_path / "new").iterdir()) == []
    write_image(tmp_path / "new" / name, np.full((4, 6, 3), (200, 100, 50), np.uint8))
    assert (tmp_path / "new" / name).read_bytes().startswith(head)
    back = cv2.imread(str(tmp_path / "new" / name))[..., ::-1]
    assert np.abs(back.astype(int) - (200, 100, 50)).max() < 4


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.gif", r"suffixes \.png, \.jpg, \.jpeg"),
        ("a", "to write; allowed"),
        (".", "which is a folder; allowed"),
        ("/", "pass e.g. file.png"),
        ("folder.png", "Is a directory"),
        ("file/a.png", "File exists|Not a directory"),
        ("/proc/none/a.png", "No such file"),
    ],
)
def test_an_unwritable_target_is_refused(name, message, tmp_path):
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=message):
        check_target(tmp_path / name, IMAGES)
