"""A camera and `dopepp node --ros2` in two processes on one machine: what is lost, and how late.

    python benchmarks/node.py --pictures 300 --rate 30

Then the node is killed and started again while the camera goes on. Received are the images that
reached the node; of these it leaves out those that a newer one replaced while it was busy. Late is
from publishing an image to having its poses back here.
"""

from __future__ import annotations

import argparse
import array
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import numpy as np

from dopepp.parts.catalogue import load_part
from dopepp.robot.nodes.messages import image_fields
from dopepp.robot.nodes.ros2 import native
from dopepp.virtual import PRESETS, Factory

TOPIC = "/camera/image_raw"
FRAME = "camera_optical_frame"
PART = "pivconnector"
START_S = 180.0
NODE_NAME = "dope"


class Camera:
    """Publishes images in turn, and hears the node's answers."""

    def __init__(self, size: tuple[int, int]) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile

        factory = Factory([load_part(PART)], PRESETS["quickstart"].reframed(*size), 2)
        rendered = [factory.render(0, number) for number in range(9, 15)]
        header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": FRAME}
        self.images = [
            native("sensor_msgs/Image", image_fields(rendering.image, header))
            for rendering in rendered
        ]
        K = rendered[0].scene.K
        self.info = native(
            "sensor_msgs/CameraInfo",
            {
                "header": header,
                "width": size[0],
                "height": size[1],
                "distortion_model": "plumb_bob",
                "d": array.array("d", [0.0] * 5),
                "k": K.ravel(),
                "p": np.c_[K, np.zeros(3)].ravel(),
                "r": np.eye(3).ravel(),
            },
        )
        self.node = rclpy.create_node("camera")
        self.publisher = self.node.create_publisher(
            type(self.images[0]), TOPIC, QoSProfile(depth=10)
        )
        self.beside = self.node.create_publisher(
            type(self.info), "/camera/camera_info", QoSProfile(depth=10)
        )
        poses, diagnostics = (
            type(native(kind, {}))
            for kind in ("geometry_msgs/PoseArray", "diagnostic_msgs/DiagnosticArray")
        )
        self.sent: dict[int, float] = {}
        self.late: dict[int, float] = {}
        self.told: dict[str, str] = {}
        self.node.create_subscription(poses, f"/{NODE_NAME}/poses_{PART}", self.hear, 100)
        self.node.create_subscription(diagnostics, "/diagnostics", self.note, 10)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()

    def hear(self, message) -> None:
        """Note when an answer came."""
        key = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        if key in self.sent:
            self.late[key] = 1000 * (time.perf_counter() - self.sent[key])

    def note(self, message) -> None:
        """Keep what the node says of itself."""
        self.told = {entry.key: entry.value for entry in message.status[0].values}

    def counted(self) -> dict[str, int]:
        """Return the node's counts of now."""
        self.told = {}
        wait_for("a diagnosis", lambda: "received" in self.told, 10.0)
        return {key: int(self.told[key]) for key in ("received", "replaced by newer")}

    def send(self, number: int) -> None:
        """Publish an image with its camera_info."""
        message = self.images[number % len(self.images)]
        now = self.node.get_clock().now()
        message.header.stamp = self.info.header.stamp = now.to_msg()
        self.sent[now.nanoseconds] = time.perf_counter()
        self.beside.publish(self.info)
        self.publisher.publish(message)

    def run(self, count: int, rate: float) -> None:
        """Publish at a rate."""
        start = time.perf_counter()
        for number in range(count):
            time.sleep(max(0.0, start + number / rate - time.perf_counter()))
            self.send(number)


def started(options: argparse.Namespace) -> subprocess.Popen[bytes]:
    """Start the node as a user does."""
    command = [sys.executable, "-c", "from dopepp.cli import app; app()"]
    words = [*command, "node", options.model, "--ros2"]
    return subprocess.Popen([*words, "--topic", TOPIC, "--name", NODE_NAME])


def wait_for(what: str, holds: Callable[[], bool], seconds: float = START_S) -> None:
    """Wait until something holds, or end."""
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            sys.exit(f"{what}: not within {seconds:g} s")
        time.sleep(0.05)


def measure(camera: Camera, count: int, rate: float) -> str:
    """Return a row: images sent, received, replaced, answered, and how late answers were."""
    camera.late.clear()
    wait_for("the node", lambda: camera.publisher.get_subscription_count() > 0)
    number = 0
    while not camera.late:  # until both sides know each other and numba has compiled
        camera.send(number)
        number += 1
        time.sleep(2.0)
    before = camera.counted()
    camera.sent.clear()
    camera.late.clear()
    camera.run(count, rate)
    time.sleep(1.0)
    after = camera.counted()
    received, replaced = (after[key] - before[key] for key in ("received", "replaced by newer"))
    late = np.array([*camera.late.values()])
    return (
        f"| {count} | {received} | {count - received} | {replaced} | "
        f"{len(late)} | {np.median(late):.1f} | {np.percentile(late, 95):.1f} |"
    )


def main() -> None:
    """Print a row for a node, and one for the same node killed and started again."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="pretrained/pivconnector")
    parser.add_argument("--pictures", type=int, default=300)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    options = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100))
    import rclpy

    rclpy.init()
    camera = Camera(tuple(options.size))
    print("| sent | received | lost | replaced by newer | answered | late ms, median | p95 |")
    print("| --: " * 7 + "|")
    for number in range(2):
        node = started(options)
        try:
            print(measure(camera, options.pictures, options.rate), flush=True)
        finally:
            node.kill() if number == 0 else node.terminate()
            code = node.wait(30)
        wait_for("its end", lambda: camera.publisher.get_subscription_count() == 0)
    print(f"ended with {code}; 143 is that of SIGTERM")
    camera.executor.shutdown()
    camera.thread.join(5.0)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
