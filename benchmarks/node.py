"""Lost images and latency of `dopepp node --ros2`, with a simulated camera in another process.

    python benchmarks/node.py

The node is measured, killed, started again and measured again, while the camera publishes.
"Received" is the number of images that reached the node. An image is "replaced by newer" if a newer
image arrived while the node was busy. "Latency" is the time from publishing an image to receiving
its poses.
"""

from __future__ import annotations

import array
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import numpy as np
from common import print_head, print_row

from dopepp.parts.catalogue import load_part
from dopepp.robot.nodes.messages import image_fields
from dopepp.robot.nodes.ros2 import native
from dopepp.virtual import PRESETS, Factory

TOPIC = "/camera/image_raw"
FRAME = "camera_optical_frame"
PART, MODEL = "pivconnector", "pretrained/pivconnector"
SIZE, COUNT, RATE = (320, 240), 300, 30.0  # images per row, and per second
START_S = 180.0
NODE_NAME = "dope"


class Camera:
    """Publishes images in turn, and receives the node's poses."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile

        factory = Factory([load_part(PART)], PRESETS["quickstart"].reframed(*SIZE), 2)
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
                "width": SIZE[0],
                "height": SIZE[1],
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
        self.info_publisher = self.node.create_publisher(
            type(self.info), "/camera/camera_info", QoSProfile(depth=10)
        )
        poses, diagnostics = (
            type(native(kind, {}))
            for kind in ("geometry_msgs/PoseArray", "diagnostic_msgs/DiagnosticArray")
        )
        self.sent: dict[int, float] = {}
        self.latency_ms: dict[int, float] = {}
        self.diagnostics: dict[str, str] = {}
        self.node.create_subscription(poses, f"/{NODE_NAME}/poses_{PART}", self.on_poses, 100)
        self.node.create_subscription(diagnostics, "/diagnostics", self.on_diagnostics, 10)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()

    def on_poses(self, message) -> None:
        """Record the latency of an image's poses."""
        key = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        if key in self.sent:
            self.latency_ms[key] = 1000 * (time.perf_counter() - self.sent[key])

    def on_diagnostics(self, message) -> None:
        """Store the node's diagnostics."""
        self.diagnostics = {entry.key: entry.value for entry in message.status[0].values}

    def counts(self) -> dict[str, int]:
        """Return the node's current counts of images."""
        self.diagnostics = {}
        wait_for("a diagnosis", lambda: "received" in self.diagnostics, 10.0)
        return {key: int(self.diagnostics[key]) for key in ("received", "replaced by newer")}

    def send(self, number: int) -> None:
        """Publish an image with its camera_info."""
        message = self.images[number % len(self.images)]
        now = self.node.get_clock().now()
        message.header.stamp = self.info.header.stamp = now.to_msg()
        self.sent[now.nanoseconds] = time.perf_counter()
        self.info_publisher.publish(self.info)
        self.publisher.publish(message)

    def run(self) -> None:
        """Publish :data:`COUNT` images at :data:`RATE`."""
        start = time.perf_counter()
        for number in range(COUNT):
            time.sleep(max(0.0, start + number / RATE - time.perf_counter()))
            self.send(number)


def start_node() -> subprocess.Popen[bytes]:
    """Start the node with the command line."""
    command = [sys.executable, "-c", "from dopepp.cli import app; app()"]
    words = [*command, "node", MODEL, "--ros2"]
    return subprocess.Popen([*words, "--topic", TOPIC, "--name", NODE_NAME])


def wait_for(event: str, has_happened: Callable[[], bool], seconds: float = START_S) -> None:
    """Wait for an event, and exit if it does not happen in time."""
    end = time.monotonic() + seconds
    while not has_happened():
        if time.monotonic() > end:
            sys.exit(f"{event}: not within {seconds:g} s")
        time.sleep(0.05)


def measure(camera: Camera) -> list[str]:
    """Return a row: images sent, received, lost, replaced and answered, and the latency."""
    camera.latency_ms.clear()
    wait_for("the node", lambda: camera.publisher.get_subscription_count() > 0)
    number = 0
    while not camera.latency_ms:  # until the node is connected and numba has compiled
        camera.send(number)
        number += 1
        time.sleep(2.0)
    before = camera.counts()
    camera.sent.clear()
    camera.latency_ms.clear()
    camera.run()
    time.sleep(1.0)
    after = camera.counts()
    received, replaced = (after[key] - before[key] for key in ("received", "replaced by newer"))
    latency = np.array([*camera.latency_ms.values()])
    counts = COUNT, received, COUNT - received, replaced, len(latency)
    times = np.median(latency), np.percentile(latency, 95)
    return [*map(str, counts), *(f"{time_ms:.1f}" for time_ms in times)]


def main() -> None:
    """Print a row for the node, and a row after it was killed and started again."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100))
    import rclpy

    rclpy.init()
    camera = Camera()
    print_head(
        "sent", "received", "lost", "replaced by newer", "answered", "latency ms, median", "p95"
    )
    for number in range(2):
        node = start_node()
        try:
            print_row(*measure(camera))
        finally:
            node.kill() if number == 0 else node.terminate()
            code = node.wait(30)
        wait_for("the node's end", lambda: camera.publisher.get_subscription_count() == 0)
    print(f"exit code {code} (143 after SIGTERM)")
    camera.executor.shutdown()
    camera.thread.join(5.0)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
