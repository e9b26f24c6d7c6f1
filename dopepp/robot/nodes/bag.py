"""From a recording to a recording (extra ``bags``): the node's answers to a bag, without any ROS.

The result is one ``.mcap`` of ROS 2 with the node's topics, stamped as the pictures are; a viewer
opens it beside the recording.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dopepp.core.errors import UserError, require
from dopepp.core.files import check_target, draft
from dopepp.inference.frames.ros import Bag
from dopepp.robot.nodes.messages import OVERLAY, VISION, Fields, Speaker, Triangles
from dopepp.robot.nodes.worker import Answer, Stamp, Worker, stamp_of

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

SUFFIX: Final = ".mcap"


def answer_bag(
    worker: Worker, source: Path, target: Path, topic: str | None, name: str
) -> Iterator[Answer | None]:
    """Write the answers to a recording's pictures; yield each, None where there is none.

    Args:
        worker: Looks at them.
        source: A recording of ROS 1 or 2.
        target: The ``.mcap`` to write, in its place once it is whole.
        topic: Of the pictures, where the recording has several.
        name: Of the node, which its topics begin with.

    Raises:
        UserError: The recording is unreadable, or the target cannot be written.
    """
    require("rosbags", "--bag", "bags")
    check_target(target, (SUFFIX,))
    if target.exists() and target.samefile(source):
        raise UserError(f"--out {target}, the recording itself", "another file", "name another one")
    bag, speaker = Bag(source, topic), Speaker(worker.parts)
    with draft(target) as place, _Recorder(place, speaker, name, worker) as recorder:
        for stamp, message, info in bag.messages():
            answer = worker.take(message, info, bag.topic)
            if answer is not None:
                own = stamp_of(message.header.stamp)
                recorder.write(answer, own if own != Stamp(0, 0) else _at(stamp))
            yield answer


class _Recorder:
    """A file of ROS 2 with a node's topics."""

    def __init__(self, path: Path, speaker: Speaker, name: str, worker: Worker) -> None:
        from rosbags import rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._path, self._speaker, self._name, self._worker = path, speaker, name, worker
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        for kind, text in VISION.items():
            self._store.register(get_types_from_msg(text, kind))
        # The library writes folders: a file and what is said of it, which the file says as well.
        self._folder = path.with_name("recording")
        plugin = rosbag2.StoragePlugin.MCAP
        self._writer = rosbag2.Writer(self._folder, version=9, storage_plugin=plugin)
        self._topics: dict[str, Any] = {}

    def __enter__(self) -> _Recorder:
        self._writer.open()
        for topic, kind in self._speaker.topics():
            if topic == OVERLAY and not self._worker.settings.overlay:
                continue
            named = ros_kind(kind)
            self._topics[topic] = self._writer.add_connection(
                topic if topic.startswith("/") else f"/{self._name}/{topic}",
                named, typestore=self._store,
            )  # fmt: skip
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._writer.close()
        if kind is None:
            next(self._folder.glob(f"*{SUFFIX}")).replace(self._path)

    def write(self, answer: Answer, stamp: Stamp) -> None:
        """Write what there is to say about a picture at the time it was taken."""
        for one in self._speaker.messages(answer, self._topics.__contains__):
            kind = ros_kind(one.kind)
            content = self._store.serialize_cdr(_filled(self._store, kind, one.fields), kind)
            at = stamp.sec * 10**9 + stamp.nanosec
            self._writer.write(self._topics[one.topic], at, content)


def _at(seconds: float) -> Stamp:
    whole = int(seconds)
    return Stamp(whole, int(1e9 * (seconds - whole)))


def ros_kind(kind: str) -> str:
    """Return a type's name as ROS 2 has it."""
    return kind.replace("/", "/msg/")


def _filled(store: Typestore, kind: str, fields: Fields) -> Any:
    """Return the library's message of plain values; what they leave out is 0 or empty."""
    values = {
        name: _value(store, node, fields.get(name)) for name, node in store.fielddefs[kind][1]
    }
    return store.types[kind](**values)


def _value(store: Typestore, node: Any, value: Any) -> Any:
    """Return one field's value; ``node`` says of which type it is."""
    from rosbags.interfaces import Nodetype

    what, detail = node
    if what == Nodetype.NAME:
        return _filled(store, detail, value or {})
    if what == Nodetype.BASE:
        return value if value is not None else "" if detail[0] == "string" else 0
    (inner, kind), _ = detail
    if inner == Nodetype.BASE and kind[0] != "string":
        return np.frombuffer(value, kind[0]) if isinstance(value, bytes) else np.array(
            [] if value is None else value, kind[0]
        )  # fmt: skip
    many = value.points if isinstance(value, Triangles) else value or ()
    return [_value(store, (inner, kind), one) for one in many]
