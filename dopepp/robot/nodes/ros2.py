"""A ROS 2 node, with the wheels of the package extra ``ros2`` or the rclpy of an installed ROS.

The images of several cameras are paired by their stamps (:mod:`.image_queue`) into sets.
The subscription is RELIABLE unless the camera only offers best effort, which loses large messages.
The worker runs in a thread and gets the latest image through a :class:`.image_queue.Slot`. Topics
whose message types are not installed (``vision_msgs``, ``tf2_msgs``) are skipped with a warning.
"""

from __future__ import annotations

import array
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.rotation import quaternion_to_matrix
from dopepp.inference.frames.ros import info_topic
from dopepp.robot.nodes.image_queue import MAX_LAG_S, Pace, Slot, StampPairing
from dopepp.robot.nodes.messages import (
    DIAGNOSTICS,
    OVERLAY,
    AnswerFormatter,
    Fields,
    Message,
    Triangles,
    diagnosis,
)
from dopepp.robot.nodes.views_worker import ViewsWorker
from dopepp.robot.nodes.worker import Shot, Worker, stamp_of

QUEUE_IN: Final = 5  # a shorter queue loses images on a busy machine; a longer one delays them
QUEUE_OUT: Final = 10
WAIT_S: Final = 0.2  # seconds between two checks whether the node should stop
SILENT_S: Final = 5  # seconds without an image before a warning
UNPAIRED: Final = 10  # consecutive dropped sets before a warning
CHECKPOINTS: Final = -1.0  # parameter ``confidence`` that selects the checkpoint's threshold

logger = logging.getLogger(__name__)


def run(
    worker: Worker,
    topics: Sequence[str],
    name: str,
    params: Path | None = None,
    max_lag_s: float = MAX_LAG_S,
) -> None:
    """Publish the poses in the images of ROS 2 topics until the process is interrupted.

    Several topics, one of each camera, need a :class:`ViewsWorker`, and the stamps of a set of
    images differ by at most ``max_lag_s`` seconds. ``name`` prefixes the topics of the node, and
    ``params`` is a YAML file of ROS 2 parameters.

    Raises:
        UserError: A name, the file or a parameter in it is invalid.
    """
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    if params is not None and not params.is_file():
        fix = "pass the path of an existing file"
        raise UserError(f"--params {params}, no such file", "a YAML file", fix)
    words = [] if params is None else ["--ros-args", "--params-file", str(params)]
    with _ros_errors("--params" if params else "ROS 2's environment"):
        rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        node = _Node(worker, topics, name, max_lag_s)
        executor = SingleThreadedExecutor()
        executor.add_node(node.handle)
        logger.info("%s: images of %s, poses on /%s/…", name, " and ".join(topics), name)
        while True:
            executor.spin_once(timeout_sec=WAIT_S)
    finally:
        if node is not None:
            node.slot.stop()
        rclpy.try_shutdown()


@dataclass(eq=False)
class _Camera:
    """Subscription to a camera's images, and its state."""

    topic: str
    subscriptions: Sequence[Any] = ()
    info: Any | None = None  # latest ``camera_info``
    is_reliable: bool = True
    received: int = 0
    received_before: int = 0  # number of images at the last check
    silent_s: int = 0  # seconds without an image

    @property
    def problem(self) -> str:
        """Why the camera has no images, or an empty string."""
        silence = f" for {self.silent_s} s" if self.received else ""
        is_silent = not self.received or self.silent_s >= SILENT_S
        return f"no image on {self.topic}{silence}" if is_silent else ""


class _Node:
    """ROS 2 node that subscribes to images and publishes the worker's poses in them."""

    def __init__(
        self, worker: Worker, topics: Sequence[str], name: str, max_lag_s: float = MAX_LAG_S
    ) -> None:
        import rclpy

        with _ros_errors(f"--name {name}, --topic {' --topic '.join(topics)}"):
            self.handle = rclpy.create_node(name)
            self._cameras = [_Camera(self.handle.resolve_topic_name(topic)) for topic in topics]
        if isinstance(worker, ViewsWorker) and worker.poses is None:
            worker.look_up = transform_lookup(self.handle, worker.world)
        several = len(topics) > 1
        self._pairing = StampPairing[Shot](len(topics), max_lag_s) if several else None
        self._worker, self._name = worker, name
        self._declare_parameters()
        self._clock = self.handle.get_clock()
        self._formatter, self._pace = AnswerFormatter(worker.parts), Pace()
        self._publishers: dict[str, Any] = {}
        for published, kind in (*self._formatter.topics(), DIAGNOSTICS):
            self._advertise(published, kind)
        self.slot: Slot[Sequence[Shot]] = Slot(self._answer)
        for camera in self._cameras:
            self._subscribe(camera)
        self._summary, self._has_warned = "", False
        self.handle.create_timer(1.0, self._tick)

    def _declare_parameters(self) -> None:
        """Declare the worker's settings as parameters, and apply those of the parameter file."""
        settings = asdict(self._worker.settings)
        for name, value in settings.items():
            with _ros_errors(f"parameter {name}"):
                self.handle.declare_parameter(name, CHECKPOINTS if value is None else value)
        self._update({name: self.handle.get_parameter(name).value for name in settings})
        self.handle.add_on_set_parameters_callback(self._change)

    def _change(self, parameters: Any) -> Any:
        """Apply new ROS parameters to the worker, or none if one is invalid; return the result."""
        from rcl_interfaces.msg import SetParametersResult

        names = asdict(self._worker.settings)
        changes = {entry.name: entry.value for entry in parameters if entry.name in names}
        try:
            self._update(changes)
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _update(self, parameters: dict[str, Any]) -> None:
        """Change the worker's settings; a confidence of −1 selects the checkpoint's threshold."""
        if parameters.get("confidence") == CHECKPOINTS:
            parameters = parameters | {"confidence": None}
        self._worker.update(replace(self._worker.settings, **parameters))

    def _advertise(self, topic: str, kind: str) -> None:
        """Create the publisher of a topic; warn if its message type is not installed."""
        full = topic if topic.startswith("/") else f"~/{topic}"
        try:
            message = type_of(kind)
        except ImportError:
            package = kind.partition("/")[0]
            logger.warning("%s is not installed: %s is not published", package, full)
            return
        self._publishers[topic] = self.handle.create_publisher(message, full, QUEUE_OUT)

    def _subscribe(self, camera: _Camera) -> None:
        """Replace the subscriptions to a camera's images and their ``camera_info``."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        policy = ReliabilityPolicy.RELIABLE if camera.is_reliable else ReliabilityPolicy.BEST_EFFORT
        image = "CompressedImage" if camera.topic.endswith("/compressed") else "Image"
        qos = QoSProfile(depth=QUEUE_IN, reliability=policy)
        for subscription in camera.subscriptions:
            self.handle.destroy_subscription(subscription)
        # This order delivers the camera_info before its image.
        kinds = {"CameraInfo": info_topic(camera.topic), image: camera.topic}
        takers = partial(setattr, camera, "info"), partial(self._take_image, camera)
        camera.subscriptions = [
            self.handle.create_subscription(type_of(f"sensor_msgs/{kind}"), topic, take, qos)
            for (kind, topic), take in zip(kinds.items(), takers, strict=True)
        ]

    def _take_image(self, camera: _Camera, message: Any) -> None:
        """Pass an image, or the set that it completes, to the worker's thread."""
        camera.received += 1
        shot = Shot(message, camera.info, camera.topic)
        shots: Sequence[Shot] | None = [shot]
        if self._pairing is not None:
            number = self._cameras.index(camera)
            shots = self._pairing.add(number, stamp_of(message) / 1e9, shot)
        if shots is not None:
            self.slot.put(shots)

    def _answer(self, shots: Sequence[Shot]) -> None:
        """Publish the poses in an image or a set; runs in the worker's thread."""
        answer = self._worker.process(*shots)
        if answer is None:
            return
        for message in self._formatter.messages(answer, self._is_wanted):
            self._publish(message)
        self._pace.count((self._now() - answer.stamp) / 1e9)
        self._summary = answer.result.summary

    def _tick(self) -> None:
        """Publish the diagnostics, once a second, and check each camera."""
        self._publish(self._diagnosis())
        for camera in self._cameras:
            self._check_silence(camera)
        if self._pairing_problem() and not self._has_warned:
            self._has_warned = True
            logger.warning("%s", self._pairing_problem())

    def _check_silence(self, camera: _Camera) -> None:
        """If a camera has no new images, try best effort once, then warn."""
        is_silent = camera.received == camera.received_before
        camera.received_before = camera.received
        camera.silent_s = camera.silent_s + 1 if is_silent else 0
        if not camera.received and camera.is_reliable and self._is_best_effort(camera.topic):
            camera.is_reliable = False
            logger.warning("%s is published best effort: images may be lost", camera.topic)
            self._subscribe(camera)
        elif camera.silent_s == SILENT_S:
            overlay, kind = f"/{self._name}/{OVERLAY}", "sensor_msgs/msg/Image"
            topics = self.handle.get_topic_names_and_types()
            names = [name for name, kinds in topics if kind in kinds and name != overlay]
            others = ", ".join(names) or "none"
            text = "no image on %s for %d s; topics with images: %s (--topic)"
            logger.warning(text, camera.topic, SILENT_S, others)

    def _pairing_problem(self) -> str:
        """Return why the cameras' images form no sets, or an empty string."""
        pairing = self._pairing
        if pairing is None or pairing.dropped_in_a_row < UNPAIRED:
            return ""
        topics = " and ".join(camera.topic for camera in self._cameras)
        lag, limit = 1e3 * (pairing.lag_s or 0.0), 1e3 * pairing.max_lag_s
        if lag <= limit:
            return f"stamps on {topics} do not increase: let the drivers set header.stamp"
        return (
            f"stamps on {topics} differ by {lag:.1f} ms, and --lag allows {limit:.1f} ms: trigger "
            "the cameras together, synchronise their clocks, or raise --lag"
        )

    def _diagnosis(self) -> Message:
        """Return the diagnostic message: image counts, rate, latency and the current problem."""
        self.slot.check()
        received = sum(camera.received for camera in self._cameras)
        counts = {"received": received, "replaced by newer": self.slot.replaced}
        values = {key: str(value) for key, value in counts.items()} | self._pace.values()
        if (pairing := self._pairing) is not None:
            values |= {
                f"received on {camera.topic}": str(camera.received) for camera in self._cameras
            }
            values |= {"sets": str(pairing.num_sets), "dropped sets": str(pairing.dropped)}
            values["lag (ms)"] = "" if pairing.lag_s is None else f"{1e3 * pairing.lag_s:.1f}"
        values["last image"] = self._summary
        silences = [camera.problem for camera in self._cameras]
        problems = [self._worker.problem, *silences, self._pairing_problem()]
        return diagnosis(self._now(), self._name, next(filter(None, problems), ""), values)

    def _is_best_effort(self, topic: str) -> bool:
        """Return whether a publisher of an image topic offers best-effort delivery only."""
        from rclpy.qos import ReliabilityPolicy

        offers = self.handle.get_publishers_info_by_topic(topic)
        best_effort = ReliabilityPolicy.BEST_EFFORT
        return any(offer.qos_profile.reliability == best_effort for offer in offers)

    def _publish(self, message: Message) -> None:
        """Publish a message unless the type of its topic is not installed."""
        if message.topic in self._publishers:
            self._publishers[message.topic].publish(native(message.kind, message.fields))

    def _is_wanted(self, topic: str) -> bool:
        """Return whether a topic is enabled and has subscribers."""
        if topic == OVERLAY and not self._worker.settings.overlay:
            return False
        publisher = self._publishers.get(topic)
        return publisher is not None and publisher.get_subscription_count() > 0

    def _now(self) -> int:
        """Return the ROS clock's time, nanoseconds (since 1970, unless time is simulated)."""
        return int(self._clock.now().nanoseconds)


@contextmanager
def _ros_errors(source: str) -> Iterator[None]:
    """Convert exceptions in a ``with`` block to a UserError that suggests correcting ``source``."""
    try:
        yield
    except Exception as error:  # rclpy raises many types
        allowed = "a running ROS 2, and names and values that ROS 2 accepts"
        fix = f"correct {source} according to the message"
        raise UserError(f"{source}: {error!s:.300}", allowed, fix) from error


def transform_lookup(node: Any, world: str) -> Callable[[str, int], Transform]:
    """Return a function that looks up the pose of a frame in the world in TF at a time.

    ``node`` is a node of rclpy, which receives the transforms.

    Raises:
        UserError: ``tf2_ros`` is not installed. The function raises it if TF has no transform.
    """
    try:
        from tf2_ros import Buffer, TransformListener
    except ImportError as error:
        problem = "several topics without --views, and without the package tf2_ros"
        fix = "pass --views rig.yaml, or use the rclpy of an installed ROS"
        raise UserError(problem, "camera poses from a file or from TF", fix) from error
    from rclpy.duration import Duration
    from rclpy.time import Time

    buffer = Buffer()
    buffer.listener = TransformListener(buffer, node)  # keeps the subscriptions alive

    def look_up(frame: str, stamp: int) -> Transform:
        time, wait = Time(nanoseconds=stamp), Duration(seconds=WAIT_S)
        try:
            answer = buffer.lookup_transform(world, frame, time, wait)
        except Exception as error:  # TF raises many types
            problem = f"no transform from {world} to {frame} ({error!s:.200})"
            fix = "publish it, choose another --world, or pass --views rig.yaml"
            raise UserError(problem, "the pose of each camera in TF", fix) from error
        shift, turn = answer.transform.translation, answer.transform.rotation
        R = quaternion_to_matrix(np.array([turn.w, turn.x, turn.y, turn.z]))
        return make_transform(R, np.array([shift.x, shift.y, shift.z]))

    return look_up


def native(kind: str, fields: Fields) -> Any:
    """Return a ROS 2 message of type ``kind``. Fields missing in ``fields`` are 0 or empty."""
    return _fill(type_of(kind)(), fields)


@cache
def type_of(kind: str) -> Any:
    """Return the class of a message type ``package/Name``.

    Raises:
        ImportError: The package is not installed.
    """
    package, _, name = kind.partition("/")
    return getattr(import_module(f"{package}.msg"), name)


def _fill(message: Any, fields: Fields) -> Any:
    kinds = message.get_fields_and_field_types()
    for name, value in fields.items():
        setattr(message, name, _value(getattr(message, name), kinds[name], value))
    return message


def _value(default: Any, kind: str, value: Any) -> Any:
    """Convert a value of :data:`.messages.Fields` to rclpy's value of a field of type ``kind``."""
    if isinstance(value, dict):
        return _fill(default, value)
    if isinstance(value, Triangles):
        return _points(value)
    if isinstance(value, bytes) and isinstance(default, array.array):
        return array.array("B", value)  # ROS checks other types byte by byte
    if kind == "octet":
        return bytes([value])
    if isinstance(value, list) and value and isinstance(value[0], dict):
        inner = kind.removeprefix("sequence<").removesuffix(">").removesuffix("[]")
        return [native(inner, entry) for entry in value]
    return value


@cache
def _points(triangles: Triangles) -> list[Any]:
    """Return the corners of triangles as ``geometry_msgs/Point``."""
    return [native("geometry_msgs/Point", point) for point in triangles.points]
