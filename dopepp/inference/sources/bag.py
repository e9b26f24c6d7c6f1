"""ROS recordings: ``.bag`` of ROS 1, ``.mcap``, ``.db3`` and folders of ROS 2 (extra ``bags``).

Messages are read by the definitions that ROS has for them, never by those in the file.
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
from dopepp.drawing.pictures import MAX_PIXELS, Picture, whole_picture
from dopepp.geometry.camera_file import Camera, camera_of_fields
from dopepp.inference.sources.frame import Frame

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

BAGS: Final = (".bag", ".mcap", ".db3")
"""Suffixes; ROS 2 also records into folders with a ``metadata.yaml``."""

RAW: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
CAMERA: Final = "sensor_msgs/msg/CameraInfo"

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
"""Bytes a pixel, and how OpenCV makes RGB of them."""


class Bag:
    """The pictures of one topic of a recording.

    Args:
        path: The file or folder.
        topic: Where the pictures are; needed where several topics have any.

    Raises:
        UserError: The extra is missing, the recording is unreadable, has no pictures, or several
            topics of which none was named.
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        require("rosbags", f"{path}, a ROS recording,", "bags")
        self._path, self.stem = path, path.stem
        with self._opened() as reader:
            topics = [one for one in reader.connections if one.msgtype in (RAW, COMPRESSED)]
            chosen = self._chosen(topics, topic)
            seconds = (reader.end_time - reader.start_time) / 1e9
        self._topic, self.name = chosen.topic, f"{path} {chosen.topic}"
        self.count = sum(one.msgcount for one in topics if one.topic == chosen.topic)
        self.rate = max(1.0, (self.count - 1) / seconds) if seconds > 0 else 1.0

    def frames(self, stride: int = 1) -> Iterator[Frame]:
        """Yield every so manieth picture; a UserError tells which one is damaged."""
        for number, (stamp, message) in enumerate(self._messages(self._topic, RAW, COMPRESSED)):
            if number % stride:
                continue
            try:
                image = _decoded(message)
            except Exception as error:  # whatever is wrong with a message that anybody wrote
                raise self._unreadable(f"picture {number} of {self._topic}: {error}") from error
            yield Frame(image, self.name, number, stamp)

    @cached_property
    def camera(self) -> Camera | None:
        """The camera of the ``camera_info`` beside the pictures; None where there is none.

        Of rectified pictures (``image_rect``) the lens is P's.
        """
        place, _, name = self._topic.removesuffix("/compressed").rpartition("/")
        topic = f"{place}/camera_info"
        for _, message in self._messages(topic, CAMERA):
            said = {field.lower(): value for field, value in vars(message).items()}
            fields = {"image_width": int(said["width"]), "image_height": int(said["height"])}
            if name.startswith("image_rect"):
                K = said["p"].reshape(3, 4)[:, :3].ravel().tolist()
                return camera_of_fields({**fields, "K": K}, f"{self._path} {topic}")
            lens = {"D": said["d"].tolist(), "distortion_model": said["distortion_model"]}
            fields |= {"K": said["k"].tolist(), **lens}
            return camera_of_fields(fields, f"{self._path} {topic}")
        return None

    def _messages(self, topic: str, *kinds: str) -> Iterator[tuple[float, Any]]:
        """Yield a topic's messages of some kinds and when they were taken, seconds since 1970."""
        from rosbags.typesys import Stores, get_typestore

        of_ros1 = self._path.suffix == ".bag"
        store = get_typestore(Stores.ROS1_NOETIC if of_ros1 else Stores.ROS2_HUMBLE)
        decode = store.deserialize_ros1 if of_ros1 else store.deserialize_cdr
        with self._opened() as reader:
            ours = [one for one in reader.connections if one.topic == topic]
            wanted = [one for one in ours if one.msgtype in kinds]
            # Without any, a reader would yield all.
            for connection, recorded_ns, content in reader.messages(wanted) if wanted else ():
                message: Any = decode(content, connection.msgtype)
                stamp = message.header.stamp
                yield (stamp.sec + stamp.nanosec / 1e9) or recorded_ns / 1e9, message

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """Open the recording; what the library says of a damaged one becomes a UserError."""
        from rosbags import rosbag1, rosbag2

        try:
            kind = rosbag1.Reader if self._path.suffix == ".bag" else rosbag2.Reader
            with kind(self._path) as reader:
                yield reader
        except (UserError, GeneratorExit):
            raise
        except Exception as error:  # of rosbags, SQLite, YAML, a decompressor …
            raise self._unreadable(f"{error}") from error

    def _chosen(self, topics: Sequence[Connection], topic: str | None) -> Connection:
        names = sorted({one.topic for one in topics})
        if len(names) == 1 and topic is None:
            return topics[0]
        for one in topics:
            if one.topic == topic:
                return one
        got = "without pictures" if not names else f"with pictures on {len(names)} topics"
        got = got if topic is None else f"without pictures on {topic}"
        allowed = f"one of {', '.join(names)}" if names else f"a topic of {RAW} or {COMPRESSED}"
        raise UserError(f"{self._path} {got}", allowed, "name it: --topic /camera/image_raw")

    def _unreadable(self, reason: str) -> UserError:
        allowed = f"a ROS recording ({', '.join(BAGS)}, or a folder with metadata.yaml)"
        return UserError(f"{self._path}: {reason:.300}", allowed, "copy or record it again")


def is_bag_folder(path: Path) -> bool:
    """Tell a ROS 2 recording from a folder of pictures."""
    return (path / "metadata.yaml").is_file()


def _decoded(message: Any) -> Picture:
    """Return a message's picture as RGB; a ValueError: it is not what it says, or too large."""
    if hasattr(message, "format"):
        picture = whole_picture(message.data.tobytes(), ("JPEG", "PNG"))
        return np.ascontiguousarray(np.asarray(picture.convert("RGB")))
    if message.encoding not in ENCODINGS:
        known = ", ".join(ENCODINGS)
        raise ValueError(f"encoding {message.encoding!r:.40}, none of {known}")
    size, code = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    if not 0 < height * width <= MAX_PIXELS or step < size * width:
        raise ValueError(f"{width}×{height} pixels in rows of {step} bytes")
    rows = message.data[: height * step].reshape(height, step)[:, : size * width]
    pixels = np.ascontiguousarray(rows.reshape(height, width, size))
    return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code))
