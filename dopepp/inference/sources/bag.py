"""ROS recordings: ``.bag`` of ROS 1, ``.mcap``, ``.db3`` and folders of ROS 2 (extra ``bags``).

Messages are read by the definitions that ROS has for them, never by those in the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from dopepp.core.errors import UserError, require
from dopepp.geometry.camera_file import Camera
from dopepp.inference.sources.message import (
    CAMERA,
    COMPRESSED,
    RAW,
    info_of,
    info_topic,
    is_rectified,
    picture_of,
)
from dopepp.inference.sources.source import Frame

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

BAGS: Final = (".bag", ".mcap", ".db3")
"""Suffixes; ROS 2 also records into folders with a ``metadata.yaml``."""


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
        self.topic, self.name = chosen.topic, f"{path} {chosen.topic}"
        self.count = sum(one.msgcount for one in topics if one.topic == chosen.topic)
        self.rate = max(1.0, (self.count - 1) / seconds) if seconds > 0 else 1.0

    def frames(self, stride: int = 1) -> Iterator[Frame]:
        """Yield every so manieth picture; a UserError tells which one is damaged."""
        for number, (stamp, message) in enumerate(self._messages(self.topic, RAW, COMPRESSED)):
            if number % stride:
                continue
            try:
                image = picture_of(message)
            except Exception as error:  # whatever is wrong with a message that anybody wrote
                raise self._unreadable(f"picture {number} of {self.topic}: {error}") from error
            yield Frame(image, self.name, number, stamp)

    @cached_property
    def camera(self) -> Camera | None:
        """The camera of the ``camera_info`` beside the pictures; None where there is none.

        Of rectified pictures (``image_rect``) the lens is P's.
        """
        topic = info_topic(self.topic)
        for _, message in self._messages(topic, CAMERA):
            return info_of(message).camera(f"{self._path} {topic}", is_rectified(self.topic))
        return None

    def messages(self) -> Iterator[tuple[float, Any, Any | None]]:
        """Yield when each picture was taken, its message, and the ``camera_info`` that holds then.

        That is the latest one, of the first pictures the first; None where there is none at all.
        """
        beside = info_topic(self.topic)
        info = next((message for _, message in self._messages(beside, CAMERA)), None)
        for stamp, message in self._messages((self.topic, beside), RAW, COMPRESSED, CAMERA):
            if hasattr(message, "distortion_model"):
                info = message
            else:
                yield stamp, message, info

    def _messages(self, topics: str | Sequence[str], *kinds: str) -> Iterator[tuple[float, Any]]:
        """Yield topics' messages of some kinds and when they were taken, seconds since 1970."""
        from rosbags.typesys import Stores, get_typestore

        of_ros1 = self._path.suffix == ".bag"
        store = get_typestore(Stores.ROS1_NOETIC if of_ros1 else Stores.ROS2_HUMBLE)
        decode = store.deserialize_ros1 if of_ros1 else store.deserialize_cdr
        named = (topics,) if isinstance(topics, str) else topics
        with self._opened() as reader:
            ours = [one for one in reader.connections if one.topic in named]
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
