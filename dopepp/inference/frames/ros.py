"""Frames of ROS: image and camera messages, live or recorded, and recordings (extra ``bags``).

Recordings are ``.bag`` of ROS 1, and ``.mcap``, ``.db3`` and folders of ROS 2. Their messages are
decoded with ROS's definitions, never with definitions in the file. Functions access messages by
field name, so messages of rclpy and of rosbags are both supported.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np

from dopepp.core.errors import UserError, require
from dopepp.drawing.pictures import MAX_PIXELS, RGBImage, whole_image
from dopepp.geometry.camera import crop_camera, resize_camera
from dopepp.geometry.camera_file import Camera, camera_of_fields
from dopepp.inference.frames.source import CameraFrame, FrameSource

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

RAW: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
CAMERA: Final = "sensor_msgs/msg/CameraInfo"

BAGS: Final = (".bag", ".mcap", ".db3")  # ROS 2 also records into folders with a `metadata.yaml`

# Bytes per pixel, and OpenCV's conversion to RGB.
ENCODINGS: Final[dict[str, tuple[int, int | None]]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
}


def decode_image(message: Any) -> RGBImage:
    """Return the RGB image of an ``Image`` or ``CompressedImage`` message.

    Raises:
        ValueError: The encoding is not supported, or the image's size is inconsistent or too large.
    """
    if hasattr(message, "format"):
        image = whole_image(bytes(message.data), ("JPEG", "PNG"))
        return np.ascontiguousarray(np.asarray(image.convert("RGB")))
    if message.encoding not in ENCODINGS:
        supported = ", ".join(ENCODINGS)
        raise ValueError(f"unsupported encoding {message.encoding!r:.40}; supported: {supported}")
    pixel_bytes, code = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    if not 0 < height * width <= MAX_PIXELS or step < pixel_bytes * width:
        size = f"{width}×{height} pixels in rows of {step} bytes"
        raise ValueError(f"image of {size}: empty, too large, or rows too short")
    data = np.frombuffer(message.data, np.uint8)
    rows = data[: height * step].reshape(height, step)[:, : pixel_bytes * width]
    pixels = np.ascontiguousarray(rows.reshape(height, width, pixel_bytes))
    return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code))


def is_rectified(topic: str) -> bool:
    """Return whether a topic's name states undistorted images, whose K is the left part of P."""
    return topic.removesuffix("/compressed").rpartition("/")[2].startswith("image_rect")


def info_topic(topic: str) -> str:
    """Return the ``camera_info`` topic of an image topic."""
    return f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"


def is_cropped(info: Any) -> bool:
    """Return whether the images of a ``camera_info`` message show a region of the sensor."""
    return bool(info.roi.width and info.roi.height)


def camera_of_info(info: Any, source: str, rectified: bool) -> Camera:
    """Return the pinhole camera of a ``camera_info`` message of ROS 1 (D, K, P) or 2 (d, k, p).

    Of undistorted images (``rectified``), P applies instead of K. K and P belong to the sensor's
    image, of which the region of interest may be read out, with binning.

    Raises:
        UserError: The camera is not calibrated, or is not a pinhole camera.
        ValueError: A field has a wrong type or length.
    """

    def numbers(name: str) -> list[float]:
        return [float(x) for x in getattr(info, name if hasattr(info, name) else name.lower())]

    if not any(numbers("K")):
        raise UserError(
            f"{source}, whose K is all zeros",
            "the camera_info of a calibrated camera",
            "calibrate it (`dopepp calibrate camera`) and give the driver the file, or pass it "
            "here: --camera camera.yaml",
        )
    region = 0, 0, int(info.width), int(info.height)
    fields: dict[str, object] = {"image_width": region[2], "image_height": region[3]}
    if rectified:
        fields["K"] = np.reshape(numbers("P"), (3, 4))[:, :3].ravel().tolist()
    else:
        lens = {"D": numbers("D"), "distortion_model": info.distortion_model}
        fields |= {"K": numbers("K"), **lens}
    sensor = camera_of_fields(fields, source)
    if is_cropped(info):
        roi = info.roi
        region = int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)
    x, y, width, height = region
    across, down = max(1, int(info.binning_x)), max(1, int(info.binning_y))
    K = resize_camera(crop_camera(sensor.K, x, y), 1 / across, 1 / down)
    size = (width // across, height // down)
    return Camera(size, K, sensor.distortion, source, is_cropped(info))


class Bag(FrameSource):
    """Images of one topic of a ROS recording; the topic is required if several have images.

    Raises:
        UserError: The extra ``bags`` is not installed, the recording is unreadable or has no
            images, or several topics have images and none is selected.
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        require("rosbags", f"{path}, a ROS recording,", "bags")
        self._path, self.stem = path, path.stem
        with self._opened() as reader:
            topics = [link for link in reader.connections if link.msgtype in (RAW, COMPRESSED)]
            self.topic = self._select(topics, topic)
            seconds = (reader.end_time - reader.start_time) / 1e9
        self.name, self.is_rectified = f"{path} {self.topic}", is_rectified(self.topic)
        self.count = sum(link.msgcount for link in topics if link.topic == self.topic)
        self.rate = max(1.0, (self.count - 1) / seconds) if seconds > 0 else 1.0

    def frames(self, stride: int = 1) -> Iterator[CameraFrame]:
        """Yield every ``stride``-th image.

        Raises:
            UserError: An image is damaged.
        """
        for number, (seconds, message) in enumerate(self._messages([self.topic], RAW, COMPRESSED)):
            if number % stride:
                continue
            try:
                image = decode_image(message)
            except Exception as error:  # untrusted messages can raise any exception
                raise self._unreadable(f"image {number} of {self.topic}: {error}") from error
            yield CameraFrame(image, self.name, number, seconds)

    @cached_property
    def camera(self) -> Camera | None:
        """Camera of the images' ``camera_info``; None if the recording has none."""
        topic = info_topic(self.topic)
        for _, message in self._messages([topic], CAMERA):
            return camera_of_info(message, f"{self._path} {topic}", self.is_rectified)
        return None

    def messages(self) -> Iterator[tuple[float, Any, Any | None]]:
        """Yield time (seconds since 1970), message and latest ``camera_info``, if any, of an image.

        Images before the first ``camera_info`` message are paired with that message.
        """
        topic = info_topic(self.topic)
        info = next((message for _, message in self._messages([topic], CAMERA)), None)
        for seconds, message in self._messages([self.topic, topic], RAW, COMPRESSED, CAMERA):
            if hasattr(message, "distortion_model"):
                info = message
            else:
                yield seconds, message, info

    def _messages(self, topics: Sequence[str], *kinds: str) -> Iterator[tuple[float, Any]]:
        """Yield time (seconds since 1970) and content of the messages of these topics and types."""
        from rosbags.typesys import Stores, get_typestore

        is_ros1 = self._path.suffix == ".bag"
        store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
        decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        with self._opened() as reader:
            every = reader.connections
            links = [link for link in every if link.topic in topics and link.msgtype in kinds]
            # Without a selected connection, the reader would yield the messages of every topic.
            for link, recorded_ns, content in reader.messages(links) if links else ():
                message: Any = decode(content, link.msgtype)
                stamp = message.header.stamp
                yield (stamp.sec + stamp.nanosec / 1e9) or recorded_ns / 1e9, message

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """Open the recording, and convert the library's errors about damaged files to UserError."""
        from rosbags import rosbag1, rosbag2

        try:
            kind = rosbag1.Reader if self._path.suffix == ".bag" else rosbag2.Reader
            with kind(self._path) as reader:
                yield reader
        except (UserError, GeneratorExit):
            raise
        except Exception as error:  # raised by rosbags, SQLite, YAML or a decompressor
            raise self._unreadable(f"{error}") from error

    def _select(self, links: Sequence[Connection], topic: str | None) -> str:
        """Return the requested image topic, or the only image topic, or raise a ``UserError``."""
        names = sorted({link.topic for link in links})
        if topic in names or (topic is None and len(names) == 1):
            return topic or names[0]
        problem = f"with images on {len(names)} topics" if names else "without images"
        problem = problem if topic is None else f"without images on {topic}"
        allowed = f"one of {', '.join(names)}" if names else f"a topic of {RAW} or {COMPRESSED}"
        fix = f"pass --topic {names[0]}" if names else "record a topic of images"
        raise UserError(f"{self._path} {problem}", allowed, fix)

    def _unreadable(self, reason: str) -> UserError:
        allowed = f"a ROS recording ({', '.join(BAGS)}, or a folder with metadata.yaml)"
        return UserError(f"{self._path}: {reason:.300}", allowed, "copy it again, or record again")


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder is a ROS 2 recording."""
    return (path / "metadata.yaml").is_file()
