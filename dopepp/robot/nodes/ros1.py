"""A node of ROS 1, where its rospy can be imported (Debian's and Ubuntu's packages, or Noetic's).

``vision_msgs`` of ROS 1 are others, with numbers for names, so there are no ``detections``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, Final

from dopepp.core.errors import UserError
from dopepp.inference.sources.message import info_topic
from dopepp.robot.nodes.messages import DIAGNOSTICS, Message
from dopepp.robot.nodes.native import native, type_of
from dopepp.robot.nodes.pump import Pump
from dopepp.robot.nodes.worker import Worker

LARGEST: Final = 2**26
"""Bytes that are read at once: with fewer, rospy hands out old pictures."""

TICK_S: Final = 0.5

logger = logging.getLogger(__name__)


def run(worker: Worker, topic: str, name: str, words: Sequence[str] = ()) -> None:
    """Answer the pictures on a topic until the process is interrupted or ROS ends it.

    ``words`` are ROS's own: ``__name:=…``, ``image:=…``. A :class:`UserError`: there is no master.
    """
    import rosgraph
    import rospy

    if not rosgraph.is_master_online():
        got, fix = "--ros1 without a master", "start roscore, or correct ROS_MASTER_URI"
        raise UserError(got, "a ROS 1 master that answers", fix)
    rospy.init_node(name, argv=["dopepp", *words], disable_signals=True)
    node = _Node(worker, rospy.resolve_name(topic))
    logger.info("pictures of %s, poses on %s/…", rospy.resolve_name(topic), rospy.get_name())
    try:
        while not rospy.is_shutdown():
            rospy.rostime.wallsleep(TICK_S)
            node.tick()
    finally:
        node.stop()
        rospy.signal_shutdown("the node has ended")


class _Node:
    """What subscribes and publishes."""

    def __init__(self, worker: Worker, topic: str) -> None:
        import rospy

        self._worker = worker
        self._publishers: dict[str, Any] = {}
        self._pump = Pump(worker, topic, self._publish, self._is_heard, lambda: rospy.get_time())
        for one, kind in (*self._pump.speaker.topics(), DIAGNOSTICS):
            self._advertise(one, kind)
        for parameter, value in asdict(worker.settings).items():
            if not rospy.has_param(f"~{parameter}"):
                rospy.set_param(f"~{parameter}", value)
        self.tick()
        compressed = topic.endswith("/compressed")
        kind = type_of(f"sensor_msgs/{'CompressedImage' if compressed else 'Image'}")
        own = {"queue_size": 1, "buff_size": LARGEST, "tcp_nodelay": True}
        info = type_of("sensor_msgs/CameraInfo")
        rospy.Subscriber(info_topic(topic), info, self._pump.take_info, **own)
        rospy.Subscriber(topic, kind, self._pump.take_picture, **own)

    def stop(self) -> None:
        """Let the picture that is looked at be the last."""
        self._pump.slot.stop()

    def tick(self) -> None:
        """Take over changed parameters, and say how the node does."""
        import rospy

        own = asdict(self._worker.settings)
        said = {name: rospy.get_param(f"~{name}", value) for name, value in own.items()}
        if isinstance(said["confidence"], int):
            said["confidence"] = float(said["confidence"])
        if said != own:
            try:
                self._worker.set(replace(self._worker.settings, **said))
            except UserError as error:
                logger.warning("%s; they stay as they were", error)
                for name, value in own.items():
                    rospy.set_param(f"~{name}", value)
        self._publish(self._pump.diagnosis(rospy.get_name()))

    def _advertise(self, topic: str, kind: str) -> None:
        import rospy

        if kind.startswith("vision_msgs/"):
            return
        own = topic if topic.startswith("/") else f"~{topic}"
        try:
            message = type_of(kind)
        except ImportError:
            logger.warning("without %s: %s is not published", kind.partition("/")[0], own)
            return
        self._publishers[topic] = rospy.Publisher(own, message, queue_size=10)

    def _publish(self, message: Message) -> None:
        if message.topic in self._publishers:
            self._publishers[message.topic].publish(native(message.kind, message.fields))

    def _is_heard(self, topic: str) -> bool:
        publisher = self._publishers.get(topic)
        return publisher is not None and publisher.get_num_connections() > 0
