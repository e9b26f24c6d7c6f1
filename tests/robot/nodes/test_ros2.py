"""The ROS 2 node: native messages, parameters, best-effort cameras and the slot of images."""

import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dopepp.robot.nodes import image_queue
from dopepp.robot.nodes.image_queue import Pace, Slot, StampPairing
from dopepp.robot.nodes.messages import diagnosis, image_fields
from dopepp.robot.nodes.ros2 import _Node, native
from dopepp.robot.nodes.worker import Worker, WorkerSettings


def test_messages_are_converted_to_native_messages():
    pytest.importorskip("rclpy", reason="needs the extra ros2")
    message = diagnosis(3 * 10**9 + 4, "dope", "oh", {"rate": "30"})
    filled = native(message.kind, message.fields)
    assert (filled.header.stamp.sec, filled.status[0].level) == (3, b"\x01")
    assert filled.status[0].values[0].value == "30"
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    data = native("sensor_msgs/Image", image_fields(image, {})).data
    np.testing.assert_array_equal(np.frombuffer(data, np.uint8).reshape(2, 4, 3), image)


@pytest.mark.parametrize(
    ("stamps", "problem"),
    [
        ([(0.0, 0.0)] * 20, "stamps on /left and /right do not increase: let the drivers set"),
        ([(k, k + 0.05) for k in range(20)], "stamps on /left and /right differ by"),
        ([(k, k + 0.01) for k in range(20)], ""),
    ],
)
def test_images_that_form_no_sets_are_a_problem_with_a_remedy(stamps, problem):
    pairing = StampPairing(2)
    for pair in stamps:
        for camera, stamp in enumerate(pair):
            pairing.add(camera, stamp, None)
    cameras = [SimpleNamespace(topic=topic) for topic in ("/left", "/right")]
    text = _Node._pairing_problem(SimpleNamespace(_pairing=pairing, _cameras=cameras))
    assert text.startswith(problem)
    assert bool(text) == bool(problem)


def test_parameters_change_while_the_node_runs(estimator, tmp_path):
    rclpy = pytest.importorskip("rclpy", reason="needs the extra ros2")
    from rclpy.parameter import Parameter

    params = tmp_path / "dope.yaml"
    params.write_text("/**:\n  ros__parameters:\n    confidence: 0.25\n")
    rclpy.init(args=["--ros-args", "--params-file", str(params)])
    try:
        worker = Worker(estimator)
        node = _Node(worker, ["/camera/image_raw"], "dope_of_a_test")
        assert worker.settings == WorkerSettings(confidence=0.25)
        for value, is_accepted in ((0.75, True), (7.0, False)):
            (result,) = node.handle.set_parameters([Parameter("confidence", value=value)])
            assert result.successful == is_accepted
        assert "a number from 0 to 1" in result.reason
        assert worker.settings == WorkerSettings(confidence=0.75)
        node.handle.set_parameters([Parameter("confidence", value=-1.0)])
        assert worker.settings == WorkerSettings()
        node.slot.stop()
    finally:
        rclpy.try_shutdown()


def test_images_of_a_best_effort_camera_arrive(estimator, camera, caplog):
    rclpy = pytest.importorskip("rclpy", reason="needs the extra ros2")
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import qos_profile_sensor_data

    rclpy.init()
    try:
        node = _Node(Worker(estimator), ["/best"], "dope_of_a_test")
        driver = rclpy.create_node("camera")
        image = native("sensor_msgs/Image", image_fields(camera.images[0], {}))
        publisher = driver.create_publisher(type(image), "/best", qos_profile_sensor_data)
        executor = SingleThreadedExecutor()
        executor.add_node(node.handle)
        for _ in range(100):
            publisher.publish(image)
            executor.spin_once(timeout_sec=0.1)
            if node._cameras[0].received:
                break
        assert node._cameras[0].received
        assert "best effort" in caplog.text
        node.slot.stop()
    finally:
        rclpy.try_shutdown()


@pytest.mark.slow
def test_no_image_is_lost_between_processes_and_a_killed_node_restarts():
    pytest.importorskip("rclpy", reason="needs the extra ros2")
    script = Path(__file__).parents[3] / "benchmarks" / "node.py"
    command = [sys.executable, str(script), "--rate", "10", "--pictures", "50"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stderr
    rows = [line.split("|")[1:-1] for line in done.stdout.splitlines() if line.startswith("| 50")]
    assert len(rows) == 2
    for row in rows:
        sent, received, lost, _, answered, *_ = (float(item) for item in row)
        assert (sent, received, lost) == (50, 50, 0)
        assert answered > 0
    assert "exit code 143" in done.stdout


def test_a_slow_handler_receives_the_newest_item():
    begun, go_on, done = threading.Event(), threading.Event(), threading.Event()
    handled = []

    def handle(item):
        handled.append(item)
        begun.set()
        go_on.wait(10)
        if item == 9:
            done.set()

    slot = Slot(handle)
    slot.put(0)
    assert begun.wait(10)
    for item in range(1, 10):
        slot.put(item)
    go_on.set()
    assert done.wait(10)
    slot.stop()
    assert handled == [0, 9]
    assert slot.replaced == 8


def test_an_exception_of_the_thread_is_raised_again():
    slot = Slot(lambda item: 1 / item)
    slot.put(0)
    slot._thread.join(10)
    for call in (slot.check, lambda: slot.put(1)):
        with pytest.raises(ZeroDivisionError):
            call()


def test_pace_measures_rate_and_latency(monkeypatch):
    seconds = iter(range(100))
    clock = SimpleNamespace(monotonic=lambda: next(seconds) / 10)
    monkeypatch.setattr(image_queue, "time", clock)
    pace = Pace()
    assert pace.values() == {"answered": "0"}
    for latency in (0.01, 0.02, 0.03):
        pace.count(latency)
    values = pace.values()
    assert (values["rate (1/s)"], values["latency, median (ms)"]) == ("10.0", "20.0")
