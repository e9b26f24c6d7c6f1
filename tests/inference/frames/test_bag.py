"""Images and cameras of ROS recordings that ``rosbags`` wrote."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.geometry.camera_file import Camera
from dopepp.inference.frames import open_sources
from dopepp.inference.frames.source import Lens, choose_camera

pytest.importorskip("rosbags")
from functools import partial

from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

K = [600.0, 0, 31.5, 0, 601.0, 23.5, 0, 0, 1]
P = [500.0, 0, 31.5, 0, 0, 501.0, 23.5, 0, 0, 0, 1, 0]
LENS = [-0.2, 0.1, 0.001, 0.002, 0.0]
IMAGE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)


class Recording:
    """Messages of ROS 1 or 2 on topics, written to a file or folder."""

    def __init__(self, kind, folder):
        self._is_ros1 = kind == "bag"
        self.path = folder / {"bag": "run.bag"}.get(kind, "run")
        self._store = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.ROS2_HUMBLE)
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        ros2 = partial(rosbag2.Writer, version=9, storage_plugin=plugin)
        self._writer = (rosbag1.Writer if self._is_ros1 else ros2)(self.path)
        self._topics = {}

    def __enter__(self):
        self._writer.open()
        return self

    def __exit__(self, *_):
        self._writer.close()

    def write(self, topic, kind, second, **fields):
        name, types = f"sensor_msgs/msg/{kind}", self._store.types
        stamp = types["builtin_interfaces/msg/Time"](second, 500_000_000)
        counted = {"seq": second} if self._is_ros1 else {}
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="optical", **counted)
        message = types[name](header=header, **fields)
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, name, typestore=self._store)
        encode = self._store.serialize_ros1 if self._is_ros1 else self._store.serialize_cdr
        self._writer.write(self._topics[topic], second * 10**9, encode(message, name))

    def image(self, topic, encoding, data, second=1):
        rows = np.pad(data.reshape(len(data), -1), ((0, 0), (0, 3)))  # rows may be padded
        self.write(
            topic, "Image", second, height=data.shape[0], width=data.shape[1], encoding=encoding,
            is_bigendian=0, step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip

    def region(self, *numbers):
        return self._store.types["sensor_msgs/msg/RegionOfInterest"](*numbers, False)

    def camera(self, topic, roi=None, **changes):
        large = {"k": K, "d": LENS, "p": P, "r": np.eye(3).ravel().tolist()}
        names = {name: name.upper() if self._is_ros1 else name for name in large}
        roi = roi or self.region(0, 0, 0, 0)
        arrays = {names[first]: np.array(value, np.float64) for first, value in large.items()}
        fixed = {"height": 48, "width": 64, "distortion_model": "plumb_bob"}
        self.write(topic, "CameraInfo", 1, binning_x=0, binning_y=0, roi=roi,
                   **(fixed | arrays | changes))  # fmt: skip


@pytest.mark.parametrize("kind", ["bag", "mcap", "sqlite3"])
def test_recording_has_images_times_and_camera(kind, tmp_path):
    with Recording(kind, tmp_path) as bag:
        bag.camera("/cam/camera_info")
        bag.camera("/other/camera_info", width=640)
        for second in (1, 2, 3):
            bag.image("/cam/image_raw", "bgr8", IMAGE[..., ::-1] // second, second)
    inside = {"bag": [], "mcap": bag.path.glob("*.mcap"), "sqlite3": bag.path.glob("run*.*3")}[kind]
    for path in (bag.path, *inside):
        (source,) = open_sources([path])
        frames = list(source.frames())
        assert [frame.time for frame in frames] == [1.5, 2.5, 3.5]
        for second, frame in enumerate(frames, 1):
            np.testing.assert_array_equal(frame.image, IMAGE // second)
        assert (source.count, source.rate) == (3, pytest.approx(1, abs=1e-6))
        assert source.camera.size == (64, 48)
        np.testing.assert_allclose(source.camera.K.ravel(), K)
        assert source.camera.distortion == pytest.approx(tuple(LENS))
        assert [frame.number for frame in source.frames(stride=2)] == [0, 2]


@pytest.mark.parametrize("encoding", ["rgb8", "rgba8", "bgra8", "mono8", "8UC3", "bayer_rggb8",
                                      "yuv422_yuy2", "png", "jpeg"])  # fmt: skip
def test_every_encoding_is_converted_to_rgb(encoding, tmp_path):
    smooth = cv2.resize(IMAGE[:6, :8], (64, 48), interpolation=cv2.INTER_CUBIC)
    expected, tolerance = smooth, 0.0
    with Recording("mcap", tmp_path) as bag:
        if encoding in ("png", "jpeg"):
            coded = cv2.imencode(f".{encoding}", smooth[..., ::-1])[1].ravel()
            topic, fields = "/cam/image_raw/compressed", {"format": encoding, "data": coded}
            bag.write(topic, "CompressedImage", 1, **fields)
            bag.camera("/cam/camera_info")
            tolerance = 0.0 if encoding == "png" else 6.0
        else:
            data, expected, tolerance = coded_as(encoding, smooth)
            bag.image("/cam/image_raw", encoding, data)
    (source,) = open_sources([bag.path])
    (frame,) = source.frames()
    assert np.abs(frame.image.astype(float) - expected).mean() <= tolerance
    assert (source.camera is not None) == (encoding in ("png", "jpeg"))


def coded_as(encoding, rgb):
    """Return encoded pixels, the expected image, and the tolerated mean error of a decoder."""
    green, alpha = rgb[..., 1:2], np.full((*rgb.shape[:2], 1), 9, np.uint8)
    mosaic = green[..., 0].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = rgb[::2, ::2, 0], rgb[1::2, 1::2, 2]
    yuv = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV)
    yuyv = yuv[..., :2].copy()
    yuyv[:, 1::2, 1] = yuv[:, ::2, 2]
    return {
        "rgb8": (rgb, rgb, 0.0),
        "8UC3": (rgb[..., ::-1], rgb, 0.0),
        "rgba8": (np.dstack([rgb, alpha]), rgb, 0.0),
        "bgra8": (np.dstack([rgb[..., ::-1], alpha]), rgb, 0.0),
        "mono8": (green, np.repeat(green, 3, 2), 0.0),
        "bayer_rggb8": (mosaic[..., None], rgb, 12.0),
        "yuv422_yuy2": (yuyv, rgb, 15.0),
    }[encoding]


def test_rectified_images_have_the_camera_of_p(tmp_path):
    with Recording("mcap", tmp_path) as bag:
        bag.camera("/cam/camera_info")
        bag.image("/cam/image_rect_color", "rgb8", IMAGE)
    (source,) = open_sources([bag.path])
    assert (source.camera.K[0, 0], source.camera.distortion) == (500, ())
    straight = Camera(None, source.camera.K, (), "a file")
    assert choose_camera(None, straight, source) is straight
    with pytest.raises(UserError, match="coefficients for the rectified images"):
        choose_camera(None, replace(straight, distortion=(-0.1, 0.0, 0.0, 0.0)), source)


def test_a_region_of_interest_is_a_crop(tmp_path):
    with Recording("mcap", tmp_path) as bag:
        roi = bag.region(4, 0, 48, 24)  # x, y, height, width
        bag.camera("/cam/camera_info", roi=roi)
        bag.image("/cam/image_raw", "rgb8", np.ascontiguousarray(IMAGE[:, 4:28]))
    (source,) = open_sources([bag.path])
    camera = choose_camera(None, None, source).for_picture((24, 48))
    assert camera.K[0, 2] == 27.5  # outside the image
    assert Lens(camera).is_cropped
    whole = replace(source.camera, cropped=False)
    with pytest.raises(UserError, match="principal point"):
        whole.for_picture((24, 48))


def test_choice_among_several_topics_is_required(tmp_path):
    with Recording("bag", tmp_path) as bag:
        bag.image("/left/image_raw", "rgb8", IMAGE)
        bag.image("/right/image_raw", "rgb8", IMAGE // 2)
        bag.camera("/right/camera_info")
    (source,) = open_sources([bag.path], "/right/image_raw")
    np.testing.assert_array_equal(next(source.frames()).image, IMAGE // 2)
    assert source.camera is not None
    (left,) = open_sources([bag.path], "/left/image_raw")
    assert left.camera is None  # the other's would be a guess
    for topic, message in ((None, "on 2 topics"), ("/nowhere", "without images on /nowhere")):
        with pytest.raises(UserError, match=message) as raised:
            open_sources([bag.path], topic)
        assert "/left/image_raw, /right/image_raw" in str(raised.value)


def test_damaged_recordings_are_reported_in_one_line(tmp_path):
    with Recording("mcap", tmp_path) as bag:
        bag.image("/cam/image_raw", "mono16", IMAGE[..., :2])
        bag.image("/odd/image_raw", "rgb8", IMAGE)
        bag.camera("/cam/camera_info", distortion_model="equidistant")
    (source,) = open_sources([bag.path], "/cam/image_raw")
    with pytest.raises(UserError, match="encoding 'mono16'"):
        list(source.frames())
    with pytest.raises(UserError, match="equidistant"):
        _ = source.camera
    recording = next(bag.path.glob("*.mcap")).read_bytes()
    contents = {"a.mcap": b"", "b.mcap": b"\x89MCAP0\r\n" * 30, "c.mcap": recording[:300],
                "d.bag": b"#ROSBAG V2.0\n", "e.db3": b"SQLite format 3\0" * 9}  # fmt: skip
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=f"{name}.*allowed.*fix"):
            list(open_sources([tmp_path / name], "/odd/image_raw")[0].frames())
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metadata.yaml").write_text("!!python/object/apply:os.system [ls]")
    with pytest.raises(UserError, match="folder"):
        open_sources([tmp_path / "folder"])


def test_missing_extra_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr("dopepp.core.errors.find_spec", lambda _: None)
    (tmp_path / "run.mcap").touch()
    with pytest.raises(UserError, match=r"dopepp\[bags\]"):
        open_sources([tmp_path / "run.mcap"])
