"""Written videos: images at their times, and complete files after errors."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dopepp.core.errors import RunError
from dopepp.drawing.pictures import VideoFile


def frames(path):
    capture, result = cv2.VideoCapture(str(path)), []
    while (frame := capture.read())[0]:
        result.append(frame[1][..., ::-1])
    return result


def level(number, size=(48, 32)):
    return np.full((*size[::-1], 3), 20 * number, np.uint8)


def test_images_are_shown_at_their_times(tmp_path):
    with VideoFile(tmp_path / "new" / "clip.mp4", 10) as video:
        for number, time in enumerate((7.0, 7.1, 7.4, 7.41, 99.0, 99.1, 99.3)):
            video.write(level(number), time)
        assert not video.path.exists()
    shown = [round(frame.mean() / 20) for frame in frames(video.path)]
    # The third image is late and repeated; the fourth falls on an occupied frame; the fifth is
    # repeated for two seconds only, although it is a minute and a half late, and then time goes on.
    assert shown == [0, 1, 2, 2, 2, *[4] * 20, 5, 6, 6]
    assert [path.name for path in video.path.parent.iterdir()] == ["clip.mp4"]


@pytest.mark.parametrize("size", [(47, 31), (48, 31)])
def test_odd_sides_are_complete(tmp_path, size):
    image = level(2, size)
    image[:, -1] = image[-1] = 240
    with VideoFile(tmp_path / "clip.mp4", 10) as video:
        video.write(image, 0)
    (shown,) = frames(video.path)
    assert shown.shape == (32, 48, 3)
    assert shown[size[1] - 1 :].mean() > 200


def test_a_video_is_complete_after_an_interruption(tmp_path):
    def interrupted():
        with VideoFile(tmp_path / "clip.mp4", 10) as video:
            for number in range(3):
                video.write(level(number), number / 10)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(frames(tmp_path / "clip.mp4")) == 3


@pytest.mark.parametrize("num_written", [0, 1])
def test_a_full_disk_is_an_error_and_keeps_the_written_frames(
    tmp_path, monkeypatch, capfd, num_written
):
    video = VideoFile(tmp_path / "a.mp4", 10)
    for number in range(num_written):
        video.write(level(number), number / 10)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(RunError, match="no space left"):
        video.write(level(1), 0.1)
    video.close()
    assert [len(frames(path)) for path in tmp_path.iterdir()] == [1] * num_written
    assert capfd.readouterr().err == ""  # no message of OpenCV


def test_missing_frames_are_an_error(tmp_path):
    video = VideoFile(tmp_path / "a.mp4", 10)
    for number in range(30):
        video.write(np.random.default_rng(number).integers(0, 256, (48, 64, 3), np.uint8), number)
    video._written += 5
    with pytest.raises(RunError, match="disk full"):
        video.close()
