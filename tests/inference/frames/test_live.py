"""Live cameras: the newest frame, although OpenCV and the driver buffer frames."""

import queue
import threading
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest

from dopepp.core.errors import RunError, UserError
from dopepp.inference.frames import media, open_sources
from dopepp.inference.frames.media import Live

PERIOD = 1 / 30
INFERENCE = 0.2


class Camera:
    """A simulated camera with 30 frames per second, which buffers unread frames."""

    def __init__(self):
        self._buffer = queue.Queue()
        self._now, self._made, self._reading = 0.0, 0, False
        self.released = threading.Event()

    def now(self):
        return self._now

    def taken(self, image):
        """Return the capture time that an image encodes, seconds."""
        return (int(image[0, 0, 0]) + 256 * int(image[0, 0, 1])) * PERIOD

    def advance(self, seconds, wait=True):
        """Advance the clock; with ``wait``, until all frames are read."""
        self._now += seconds
        while self._made * PERIOD <= self._now:
            self._buffer.put(self._made)
            self._made += 1
        if wait:
            self._buffer.join()

    def isOpened(self):  # noqa: N802
        return True

    def get(self, _):
        return 1 / PERIOD

    def read(self):
        if self._reading:
            self._buffer.task_done()
        self._reading = False
        try:
            number = self._buffer.get(timeout=0.2)
        except queue.Empty:
            return False, None
        self._reading = True
        return True, np.full((2, 2, 3), (0, number // 256, number % 256), np.uint8)

    def release(self):
        self.released.set()


@pytest.fixture
def camera(monkeypatch):
    camera = Camera()
    camera.advance(0, wait=False)
    monkeypatch.setattr(media, "_open_live", lambda _: camera)
    monkeypatch.setattr(media, "time", SimpleNamespace(time=camera.now))
    return camera


def test_slow_reader_gets_the_newest_frame(camera):
    """Simulate a minute in which each inference takes six camera periods."""
    source = Live(0)
    ages, frames = [], source.frames()
    for frame in islice(frames, 300):
        camera.advance(INFERENCE)
        ages.append(camera.now() - camera.taken(frame.image))
    assert camera.now() > 59
    assert max(ages) < 2 * INFERENCE
    frames.close()
    assert camera.released.wait(5)
    assert source.rate == pytest.approx(30)


def test_frames_have_their_arrival_times(camera):
    times = []
    for frame in islice(Live(0).frames(), 3):
        times.append(frame.time)
        camera.advance(1.0)
    assert times == pytest.approx([0, 1, 2])


class Dead(Camera):
    """Delivers ``alive`` images, then no image; with ``hangs``, ``read`` never returns."""

    def __init__(self, alive, hangs):
        super().__init__()
        self._alive, self._hangs = alive, hangs

    def read(self):
        self._alive -= 1
        if self._alive >= 0:
            return True, np.zeros((2, 2, 3), np.uint8)
        if self._hangs:
            threading.Event().wait()
        return False, None


@pytest.mark.parametrize("hangs", [False, True])
@pytest.mark.parametrize(("alive", "message"), [(0, "since it was opened"), (1, "no image for")])
def test_camera_without_further_frames_is_an_error(hangs, alive, message, monkeypatch):
    monkeypatch.setattr(media, "_open_live", lambda _: Dead(alive, hangs))
    for name in ("FIRST_S", "STALLED_S"):
        monkeypatch.setattr(media, name, 0.2)
    with pytest.raises(RunError, match=message) as raised:
        list(Live(3).frames())
    assert str(raised.value).startswith("camera 3: no image for 0.2 s")


def test_unopened_camera_is_reported_without_its_password(capfd):
    for address, name in ((97, "camera 97"), ("rtsp://me:secret@127.0.0.1:9/x", "127.0.0.1:9")):
        with pytest.raises(UserError, match=name) as raised:
            next(Live(address).frames())
        assert "secret" not in str(raised.value)
    assert Live("rtsp://me:secret@127.0.0.1:9/x").stem == "rtsp_127.0.0.1_9_x"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("address", "name"),
    [
        ("rtsp://me:secret@camera/live?token=secret#secret", "rtsp://camera/live"),
        ("http://camera/at@home?token=secret", "http://camera/at@home"),
        ("http://[1", "http://[1"),
    ],
)
def test_names_of_streams_have_no_secret(address, name):
    (source,) = open_sources([address])
    assert source.name == name
    assert "secret" not in source.stem


def test_an_invalid_address_is_reported():
    (source,) = open_sources(["http://[1"])
    with pytest.raises(UserError, match=r"http://\[1, which cannot be opened"):
        next(source.frames())
