"""The node without ROS: lines of JSON on stdout or over UDP, and processing of recordings.

The output for a recording is an ``.mcap`` of ROS 2 with the node's topics at the images' stamps. A
viewer can open both recordings together. Recordings need the package extra ``bags``.
"""

from __future__ import annotations

import logging
import socket
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dopepp.core.errors import RunError, UserError, require
from dopepp.core.files import check_target, draft
from dopepp.geometry.camera_file import Camera
from dopepp.inference.frames import FrameSource
from dopepp.inference.frames.ros import Bag
from dopepp.robot.nodes.messages import OVERLAY, VISION, AnswerFormatter, Fields, Triangles
from dopepp.robot.nodes.worker import Answer, Shot, Worker, stamp_of

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

MAX_DATAGRAM: Final = 65_507  # bytes that UDP over IPv4 carries
SUFFIX: Final = ".mcap"

logger = logging.getLogger(__name__)


def send_lines(
    worker: Worker, sources: Iterable[tuple[FrameSource, Camera]], address: str | None = None
) -> None:
    """Send the poses in each image as a line of JSON, like ``dopepp predict --json``.

    ``address`` is ``host:port`` of a UDP receiver (default: stdout).

    Raises:
        UserError: The address is invalid, or a source cannot be read.
        RunError: A camera stream ended, or the reader of stdout has exited.
    """
    with nullcontext(_print) if address is None else _datagrams(address) as send:
        for source, camera in sources:
            worker.restart()
            for frame in source.frames():
                send(worker.result(frame, camera).to_json())


@contextmanager
def _datagrams(address: str) -> Iterator[Callable[[str], None]]:
    """Open a UDP socket; yield a function that sends a line to ``address``, ``host:port``."""
    target, has_warned = _parse_address(address), False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def send(line: str) -> None:
            nonlocal has_warned
            content = f"{line}\n".encode()
            if len(content) > MAX_DATAGRAM:
                if not has_warned:
                    text = "skipped a line of %d bytes (a datagram holds %d): raise --conf"
                    logger.warning(f"{text}, or use --json", len(content), MAX_DATAGRAM)
                has_warned = True
                return
            try:
                sender.sendto(content, target)
            except OSError as error:
                raise RunError(f"--udp {address}: {error.strerror or error}") from error

        yield send


def _print(line: str) -> None:
    """Print a line and flush stdout; raise a ``RunError`` if its reader has exited."""
    try:
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()  # a reader must not wait for a full buffer
    except BrokenPipeError as error:
        raise RunError("the program that reads stdout has exited") from error


def _parse_address(text: str) -> tuple[str, int]:
    """Return the IP address and port of ``host:port``, or raise a ``UserError``."""
    host, _, port = text.rpartition(":")
    try:
        if not host or not 0 < int(port) < 65_536:
            raise ValueError(text)
        addresses = socket.getaddrinfo(host, int(port), socket.AF_INET, socket.SOCK_DGRAM)
    except (ValueError, OSError) as error:
        allowed, fix = "HOST:PORT, e.g. 192.168.0.7:5005", "pass the address of the receiver"
        raise UserError(f"--udp {text:.100}", allowed, fix) from error
    ip, number = addresses[0][4][:2]
    return str(ip), int(number)


def process_bag(
    worker: Worker, source: Path, target: Path, topic: str | None, name: str
) -> Iterator[Answer | None]:
    """Estimate the poses in a recording's images and write them to a new ``.mcap`` recording.

    ``topic`` is None if the recording has a single image topic; ``name`` prefixes the new topics.

    Yields:
        The poses in each image, or None if the image cannot be processed.

    Raises:
        UserError: The recording is unreadable, or the target cannot be written.
    """
    require("rosbags", "--bag", "bags")
    check_target(target, (SUFFIX,))
    if target.exists() and target.samefile(source):
        fix = "pass another path, e.g. --out poses.mcap"
        raise UserError(
            f"--out {target}, which is the recording to read", "the path of another file", fix
        )
    bag = Bag(source, topic)
    with draft(target) as path, _Recorder(path, name, worker) as recorder:
        for seconds, message, info in bag.messages():
            answer = worker.process(Shot(message, info, bag.topic))
            if answer is not None:
                recorder.write(answer, stamp_of(message) or round(1e9 * seconds))
            yield answer


class _Recorder:
    """Writer of an ``.mcap`` recording with the topics of a node, for a ``with`` block."""

    def __init__(self, path: Path, name: str, worker: Worker) -> None:
        from rosbags import rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._path, self._name, self._worker = path, name, worker
        self._formatter = AnswerFormatter(worker.parts)
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        for kind, text in VISION.items():
            self._store.register(get_types_from_msg(text, kind))
        # The library writes a folder: the .mcap, and metadata that the .mcap contains as well.
        self._folder = path.with_name("recording")
        plugin = rosbag2.StoragePlugin.MCAP
        self._writer = rosbag2.Writer(self._folder, version=9, storage_plugin=plugin)
        self._topics: dict[str, Any] = {}

    def __enter__(self) -> _Recorder:
        self._writer.open()
        for topic, kind in self._formatter.topics():
            if topic != OVERLAY or self._worker.settings.overlay:
                full = topic if topic.startswith("/") else f"/{self._name}/{topic}"
                self._topics[topic] = self._writer.add_connection(
                    full, _ros2_kind(kind), typestore=self._store
                )
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._writer.close()
        if kind is None:
            next(self._folder.glob(f"*{SUFFIX}")).replace(self._path)

    def write(self, answer: Answer, stamp: int) -> None:
        """Write the messages of an answer with the recording time ``stamp``, nanoseconds."""
        for message in self._formatter.messages(answer, self._topics.__contains__):
            kind = _ros2_kind(message.kind)
            content = self._store.serialize_cdr(_filled(self._store, kind, message.fields), kind)
            self._writer.write(self._topics[message.topic], stamp, content)


def _ros2_kind(kind: str) -> str:
    """Return ROS 2's full name of a message type, e.g. ``sensor_msgs/msg/Image``."""
    return kind.replace("/", "/msg/")


def _filled(store: Typestore, kind: str, fields: Fields) -> Any:
    """Return rosbags' message of type ``kind``. Fields missing in ``fields`` are 0 or empty."""
    definitions = store.fielddefs[kind][1]
    return store.types[kind](
        **{name: _value(store, node, fields.get(name)) for name, node in definitions}
    )


def _value(store: Typestore, node: Any, value: Any) -> Any:
    """Convert a value of ``Fields`` to rosbags' value of a field of type ``node``."""
    from rosbags.interfaces import Nodetype

    type_kind, detail = node
    if type_kind == Nodetype.NAME:
        return _filled(store, detail, value or {})
    if type_kind == Nodetype.BASE:
        return value if value is not None else "" if detail[0] == "string" else 0
    (inner, kind), _ = detail
    if inner == Nodetype.BASE and kind[0] != "string":
        if isinstance(value, bytes):
            return np.frombuffer(value, kind[0])
        return np.array([] if value is None else value, kind[0])
    items = value.points if isinstance(value, Triangles) else value or ()
    return [_value(store, (inner, kind), item) for item in items]
