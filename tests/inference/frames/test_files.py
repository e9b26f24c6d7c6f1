"""Frames of images, folders, patterns and videos, and errors about unreadable sources."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.inference.frames import open_sources


def grey(level, size=(32, 24)):
    return np.full((*size[::-1], 3), level, np.uint8)


@pytest.fixture
def folder(tmp_path):
    for number in (0, 2, 10):
        cv2.imwrite(str(tmp_path / f"frame{number}.png"), grey(20 * number))
    (tmp_path / "notes.txt").write_text("no image")
    return tmp_path


@pytest.fixture
def clip(tmp_path, write_clip):
    return write_clip(tmp_path / "clip.mp4", [grey(20 * number) for number in range(12)], "mp4v")


def only_frame(path):
    (source,) = open_sources([path])
    (frame,) = source.frames()
    return frame


def levels(*given, stride=1):
    frames = [frame for source in open_sources(given) for frame in source.frames(stride)]
    return [round(float(frame.image.mean()) / 20) for frame in frames]


def test_folder_pattern_and_list_of_files_are_one_sequence(folder):
    assert levels(folder) == levels(f"{folder}/*.png") == [0, 2, 10]
    assert levels(*sorted(folder.glob("*.png"))) == [0, 10, 2]  # the shell's order
    assert len(open_sources(sorted(folder.glob("*.png")))) == 1
    assert levels(folder, stride=2) == [0, 10]
    (source,) = open_sources([str(folder)])
    named = [(frame.number, Path(frame.name).name) for frame in source.frames()]
    assert named == [(0, "frame0.png"), (1, "frame2.png"), (2, "frame10.png")]
    assert (source.count, source.rate) == (3, None)


def test_sources_by_folder(folder, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    for number in (3, 4):
        (other / f"{number}.png").write_bytes((folder / "frame2.png").read_bytes())
    sources = open_sources([folder, f"{other}/*.png"], by_folder=True)
    assert [source.name for source in sources] == [f"{folder}/frame0.png", f"{other}/3.png"]
    assert [frame.number for frame in sources[1].frames()] == [3, 4]


def test_frame_numbers_are_the_numbers_of_the_files(folder):
    for name in ("000007", "000012"):
        (folder / "frame0.png").with_stem(name).write_bytes((folder / "frame0.png").read_bytes())
    (source,) = open_sources([f"{folder}/0*.png"])
    assert [frame.number for frame in source.frames()] == [7, 12]


def test_video_has_frame_numbers_and_times(clip):
    (source,) = open_sources([clip])
    assert (source.count, source.rate) == (12, 10)
    assert levels(clip) == list(range(12))
    frames = list(source.frames(stride=5))
    assert [frame.number for frame in frames] == [0, 5, 10]
    assert [frame.time for frame in frames] == pytest.approx([0, 0.5, 1])
    assert levels(clip, stride=5) == [0, 5, 10]


def test_sources_of_several_kinds_keep_their_order(folder, clip):
    assert levels(folder, clip, folder / "frame2.png") == [0, 2, 10, *range(12), 2]


def test_colour_channels_are_rgb(tmp_path, write_clip):
    frame = only_frame(
        write_clip(tmp_path / "red.avi", [np.full((24, 32, 3), (200, 0, 0), np.uint8)])
    )
    assert frame.image[..., 0].mean() > 180 > 30 > frame.image[..., 1:].mean()


@pytest.mark.parametrize("mode", ["CMYK", "P"])
def test_images_of_rare_modes_are_converted_to_rgb(tmp_path, mode):
    levels = (np.arange(64 * 48).reshape(48, 64) % 200).astype(np.uint8)
    image = Image.fromarray(levels).convert("RGB")
    image = image.quantize(200) if mode == "P" else image.convert(mode)
    image.save(tmp_path / "image.tif")
    frame = only_frame(tmp_path / "image.tif")
    assert (frame.image.shape, frame.image.dtype) == ((48, 64, 3), np.uint8)
    assert np.abs(frame.image.mean(axis=2) - levels).max() <= 2


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.png", None, "none.png, no such"),
        ("*.png", None, "matches no file"),
        ("rtmp://u:secret@host/x", None, "address rtmp://host/x"),
        (".", None, "without an image"),
        ("empty.mp4", b"", "an empty file"),
        ("noise.mp4", b"\x01\x02" * 500, "does not begin like a video"),
        ("list.mp4", b"#EXTM3U\nfile:///etc/passwd\n", "does not begin like a video"),
        ("cut.mp4", b"\0\0\0\x20ftypisom" + b"\0" * 400, "damaged or cut short"),
        ("empty.png", b"", "an empty file"),
        ("text.jpg", b"hello", "cannot identify"),
    ],
)
def test_unreadable_sources_are_reported_in_one_line(
    tmp_path, name, content, message, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    if content is not None:
        Path(name).write_bytes(content)
    with pytest.raises(UserError, match=r"got .*allowed.*fix") as raised:
        levels(name)
    assert message in str(raised.value)
    assert "secret" not in str(raised.value)
    assert capfd.readouterr().err == ""  # neither OpenCV nor FFmpeg prints a message


def test_truncated_video_yields_its_frames(tmp_path, write_clip, capfd):
    noise = np.random.default_rng(0).integers(0, 256, (12, 48, 64, 3), np.uint8)
    path = write_clip(tmp_path / "clip.avi", noise)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (source,) = open_sources([path])
    assert 0 < len(list(source.frames())) < 12
    assert capfd.readouterr().err == ""
