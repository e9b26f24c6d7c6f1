"""A node of ROS 2: the wheels of the extra ``ros2``, or the rclpy of an installed ROS.

Pictures are taken RELIABLE, unless the camera offers less: best effort loses large messages. The
queue is short and emptied at once; what waits for the network is one picture (:mod:`.pump`).
What has no messages installed (``vision_msgs``, ``tf2_msgs``) is left out, which is said.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from dopepp.core.errors import UserError
from dopepp.inference.sources.message import info_topic
from dopepp.robot.nodes.messages import DIAGNOSTICS, Message
from dopepp.robot.nodes.native import native, type_of
from dopepp.robot.nodes.pump import Pump
from dopepp.robot.nodes.worker import Worker

QUEUE_IN: Final = 5
"""With queues of one at both ends, a process that a busy machine lets wait for 33 ms loses pictures
before anybody has chosen: 10 and 33 of 300 at 30 Hz. With many, it begins with old ones."""

QUEUE_OUT: Final = 10

WAIT_S: Final = 0.2
"""Seconds between two looks at whether the node is to end."""

logger = logging.getLogger(__name__)


def run(worker: Worker, topic: str, name: str, params: Path | None = None) -> None:
    """Answer the pictures on a topic until the process is interrupted.

    ``params`` is a YAML file of parameters as ROS 2 has them. A :class:`UserError`: a name, the
    file or a parameter in it is wrong.
    """
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    if params is not None and not params.is_file():
        raise UserError(f"--params {params}, no such file", "a YAML file", "check the path")
    words = [] if params is None else ["--ros-args", "--params-file", str(params)]
    with _told("--params" if params else "ROS 2"):
        rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        node = _Node(worker, topic, name)
        executor = SingleThreadedExecutor()
        executor.add_node(node.handle)
        logger.info("%s: pictures of %s, poses on /%s/…", name, topic, name)
        while True:
            executor.spin_once(timeout_sec=WAIT_S)
    finally:
        if node is not None:
            node.stop()
        rclpy.try_shutdown()


class _Node:
    """What subscribes and publishes."""

    def __init__(self, worker: Worker, topic: str, name: str) -> None:
        import rclpy

        with _told(f"--name {name}, --topic {topic}"):
            self.handle = rclpy.create_node(name)
            self._topic = self.handle.resolve_topic_name(topic)
        self._worker, self._name = worker, name
        self._declare_parameters()
        clock = self.handle.get_clock()
        self._publishers: dict[str, Any] = {}
        self._pump = Pump(
            worker, self._topic, self._publish, self._is_heard,
            lambda: clock.now().nanoseconds / 1e9,
        )  # fmt: skip
        for one, kind in (*self._pump.speaker.topics(), DIAGNOSTICS):
            self._advertise(one, kind)
        self._is_reliable = True
        self._picture: Any = None
        self._subscribe()
        self._silent_s = 0
        self.handle.create_timer(1.0, self._tick)

    def stop(self) -> None:
        """Let the picture that is looked at be the last."""
        self._pump.slot.stop()

    def _declare_parameters(self) -> None:
        """Declare the worker's settings; a file's values take the place of the command's."""
        for name, value in asdict(self._worker.settings).items():
            with _told(f"parameter {name}"):
                self.handle.declare_parameter(name, value)
        values = {name: self.handle.get_parameter(name).value
                  for name in asdict(self._worker.settings)}  # fmt: skip
        self._worker.set(replace(self._worker.settings, **values))
        self.handle.add_on_set_parameters_callback(self._changed)

    def _changed(self, parameters: Any) -> Any:
        """Take over changed parameters, all or none."""
        from rcl_interfaces.msg import SetParametersResult

        own = asdict(self._worker.settings)
        changes = {one.name: one.value for one in parameters if one.name in own}
        try:
            self._worker.set(replace(self._worker.settings, **changes))
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _advertise(self, topic: str, kind: str) -> None:
        try:
            message = type_of(kind)
        except ImportError:
            package = kind.partition("/")[0]
            logger.warning("without %s: %s is not published", package, self._own(topic))
            return
        self._publishers[topic] = self.handle.create_publisher(message, self._own(topic), QUEUE_OUT)

    def _subscribe(self) -> None:
        """Subscribe to the pictures and what is beside them."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        policy = ReliabilityPolicy.RELIABLE if self._is_reliable else ReliabilityPolicy.BEST_EFFORT
        compressed = self._topic.endswith("/compressed")
        kind = type_of(f"sensor_msgs/{'CompressedImage' if compressed else 'Image'}")
        info, beside = type_of("sensor_msgs/CameraInfo"), info_topic(self._topic)
        qos = QoSProfile(depth=QUEUE_IN, reliability=policy)
        for old in self._picture or ():
            self.handle.destroy_subscription(old)
        # In this order a picture finds the camera_info that came with it.
        self._picture = [
            self.handle.create_subscription(info, beside, self._pump.take_info, qos),
            self.handle.create_subscription(kind, self._topic, self._pump.take_picture, qos),
        ]

    def _tick(self) -> None:
        """Say once a second how the node does, and what keeps pictures from coming."""
        self._publish(self._pump.diagnosis(self._name))
        if self._pump.slot.received:
            return
        self._silent_s += 1
        if self._is_reliable and self._offers_less():
            self._is_reliable = False
            logger.warning("%s is published best effort: pictures may be lost", self._topic)
            self._subscribe()
        elif self._silent_s == 5:
            kind = "sensor_msgs/msg/Image"
            named = [one for one, kinds in self.handle.get_topic_names_and_types() if kind in kinds]
            there = ", ".join(one for one in named if one != self._own("rgb_points")) or "none"
            logger.warning("no picture on %s for 5 s; topics with pictures: %s (--topic)",
                           self._topic, there)  # fmt: skip

    def _offers_less(self) -> bool:
        from rclpy.qos import ReliabilityPolicy

        offers = self.handle.get_publishers_info_by_topic(self._topic)
        lesser = ReliabilityPolicy.BEST_EFFORT
        return any(one.qos_profile.reliability == lesser for one in offers)

    def _publish(self, message: Message) -> None:
        if message.topic in self._publishers:
            self._publishers[message.topic].publish(native(message.kind, message.fields))

    def _is_heard(self, topic: str) -> bool:
        publisher = self._publishers.get(topic)
        return publisher is not None and publisher.get_subscription_count() > 0

    def _own(self, topic: str) -> str:
        return topic if topic.startswith("/") else f"~/{topic}"


@contextmanager
def _told(what: str) -> Iterator[None]:
    """Tell in one line what ROS refuses."""
    try:
        yield
    except Exception as error:  # rclpy's are of many kinds
        allowed = "names and values that ROS 2 takes"
        raise UserError(f"{what}: {error!s:.300}", allowed, "correct it") from error
