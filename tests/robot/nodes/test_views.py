"""Images of several cameras: poses in the world, camera poses from a file or TF, diagnostics."""

import sys
import time
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.geometry.camera import invert_transform, orbited_camera
from dopepp.geometry.camera_file import Camera
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.several_views.view_files import CameraPose
from dopepp.parts.catalogue import pivconnector
from dopepp.robot.nodes.messages import AnswerFormatter
from dopepp.robot.nodes.views_worker import ViewsWorker
from dopepp.robot.nodes.worker import Shot, WorkerSettings
from dopepp.virtual import PRESETS, Factory, render
from dopepp.virtual.sensor import capture

TOPICS = ["/left/image_raw", "/right/image_raw"]


@pytest.fixture(scope="module")
def estimator():
    return PoseEstimator.load("pretrained/pivconnector_wide", refine="region")


@pytest.fixture(scope="module")
def stereo():
    """Images of a scene from two cameras, K, and the cameras' poses in a world frame."""
    scene = Factory([pivconnector()], PRESETS["wide"].reframed(640, 480), 4177).scene(0, 0)
    target = scene.objects[scene.targets[0]].T_cam_obj
    T_new_cam = [np.eye(4), orbited_camera(target[:3, 3], 0.4, 0.5)]
    T_world = orbited_camera(np.array([0.2, -0.3, 1.0]), 2.0, 1.0)  # of the first camera
    views = [scene.seen_from(T) for T in T_new_cam]
    images = [capture(render(view).image, view.sensor) for view in views]
    poses = [T_world @ invert_transform(T) for T in T_new_cam]
    return SimpleNamespace(images=images, K=scene.K, poses=poses, T_world_obj=T_world @ target)


@pytest.fixture(scope="module")
def expected(estimator, stereo):
    """The detection of ``predict_views``."""
    images, poses = stereo.images, stereo.poses
    (detection,) = estimator.predict_views(images, [stereo.K] * 2, poses).detections
    return detection


@pytest.fixture
def shots(stereo, messages):
    """Return a function that makes the shots of a set."""

    def shots(second=1.0, lag=0.004):
        made = []
        for number, (image, topic) in enumerate(zip(stereo.images, TOPICS, strict=True)):
            frame = topic.split("/")[1] + "_optical_frame"
            message = messages.image(image, second + number * lag, frame)
            info = messages.info(stereo.K, (640, 480), d=[0.0] * 5, header=message.header)
            made.append(Shot(message, info, topic))
        return made

    return shots


def poses_of(stereo, camera=None):
    return [CameraPose(T, camera) for T in stereo.poses]


@pytest.mark.parametrize("track", [False, True])
def test_poses_are_those_of_predict_views_in_the_world(
    estimator, stereo, shots, expected, track, warnings
):
    worker = ViewsWorker(estimator, poses_of(stereo), "bench", track=track)
    answer = worker.process(*shots())
    (detection,) = answer.detections
    np.testing.assert_allclose(detection.T_world_obj, expected.T_world_obj, atol=1e-9)
    assert np.linalg.norm((detection.T_world_obj - stereo.T_world_obj)[:3, 3]) < 5e-4
    assert (answer.stamp, answer.frame_id) == (10**9, "bench")
    formatter = AnswerFormatter(worker.parts)
    sent = {m.topic: m.fields for m in formatter.messages(answer, lambda topic: True)}
    pose = sent["pose_pivconnector"]
    assert pose["header"]["frame_id"] == "bench"
    np.testing.assert_allclose([*pose["pose"]["position"].values()], expected.T_world_obj[:3, 3])
    (transform,) = sent["/tf"]["transforms"]
    assert transform["child_frame_id"] == "pivconnector_0"
    (found,) = sent["detections"]["detections"]
    assert found["results"][0]["pose"]["covariance"][0] == pytest.approx(expected.covariance[3, 3])
    assert sent["rgb_points"]["width"] == 2 * 640
    assert [worker.process(*shots(second)).numbers for second in (1.1, 1.2)] == [[0]] * 2
    assert not warnings


def test_regions_of_interest_are_crops(estimator, stereo, shots, warnings):
    worker = ViewsWorker(estimator, poses_of(stereo))
    cut = []
    for image, info, topic in shots():
        pixels = np.frombuffer(image.data, np.uint8).reshape(480, 640, 3)[:, :400]
        image = SimpleNamespace(**vars(image) | {"width": 400, "step": 1200})
        image.data = pixels.tobytes()
        info.roi.width, info.roi.height = 400, 480
        cut.append(Shot(image, info, topic))
    answer = worker.process(*cut)
    assert not warnings
    for view in answer.result.views:
        assert view.image.shape == (480, 400, 3)
        np.testing.assert_allclose(view.K, stereo.K)  # the region begins at pixel (0, 0)


def test_missing_transforms_and_cameras_are_one_warning(estimator, stereo, shots, warnings):
    worker = ViewsWorker(estimator, None)

    def missing(frame, stamp):
        raise UserError(f"no transform from world to {frame}", "TF", "publish it")

    worker.look_up = missing
    assert [worker.process(*shots(second)) for second in (1, 2)] == [None] * 2
    (line,) = warnings
    assert "no transform from world to left_optical_frame" in line
    assert worker.problem == line
    known = dict(zip(("left_optical_frame", "right_optical_frame"), stereo.poses, strict=True))
    worker.look_up = lambda frame, stamp: known[frame]
    assert len(worker.process(*shots(3)).detections) == 1
    assert worker.problem == ""
    wrong = Camera((320, 240), stereo.K, (), "small.yaml")
    worker = ViewsWorker(estimator, poses_of(stereo, wrong))
    assert worker.process(*shots()) is None
    assert "small.yaml of 320×240, and images of 640×480" in warnings[-1]
    with pytest.raises(UserError, match="refine=false with images of several cameras"):
        worker.update(replace(worker.settings, refine=False))
    with pytest.raises(UserError, match="refine=false"):
        ViewsWorker(estimator, None, settings=WorkerSettings())


class Buffer:
    """TF buffer that knows one transform, as ``geometry_msgs/TransformStamped``."""

    known: tuple[str, str, np.ndarray]

    def lookup_transform(self, target, source, time, timeout):
        if (target, source) != self.known[:2]:
            raise LookupError(f'"{source}" passed to lookupTransform argument does not exist')
        T = self.known[2]
        w, x, y, z = matrix_to_quaternion(T[:3, :3])
        shift = SimpleNamespace(**dict(zip("xyz", T[:3, 3], strict=True)))
        rotation = SimpleNamespace(w=w, x=x, y=y, z=z)
        return SimpleNamespace(transform=SimpleNamespace(translation=shift, rotation=rotation))


def fake_ros(monkeypatch):
    """Replace the packages that the look-up of transforms imports."""
    modules = {"rclpy": {}, "rclpy.duration": {"Duration": dict}, "rclpy.time": {"Time": dict}}
    modules["tf2_ros"] = {"Buffer": Buffer, "TransformListener": lambda buffer, node: None}
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)


def test_camera_poses_are_looked_up_in_tf(monkeypatch, stereo):
    from dopepp.robot.nodes.ros2 import transform_lookup

    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(UserError, match=r"--views rig\.yaml"):
        transform_lookup(None, "bench")
    fake_ros(monkeypatch)
    Buffer.known = "bench", "left", stereo.poses[0]
    look_up = transform_lookup(None, "bench")
    np.testing.assert_allclose(look_up("left", 3 * 10**9 + 4), stereo.poses[0], atol=1e-9)
    with pytest.raises(UserError, match=r"no transform from bench to right .*does not exist"):
        look_up("right", 3 * 10**9 + 4)


def test_node_publishes_world_poses_and_names_its_problems(estimator, stereo, shots):
    rclpy = pytest.importorskip("rclpy", reason="needs the extra ros2")
    from dopepp.robot.nodes.ros2 import UNPAIRED, _Node

    def problem(node):
        (status,) = node._diagnosis().fields["status"]
        return status["message"], {item["key"]: item["value"] for item in status["values"]}

    rclpy.init()
    try:
        worker = ViewsWorker(estimator, poses_of(stereo), "bench")
        node = _Node(worker, TOPICS, "dope_of_a_test")
        assert problem(node)[0] == "no image on /left/image_raw"

        def send(second, lag):
            for camera, shot in zip(node._cameras, shots(second, lag), strict=True):
                camera.info = shot.info
                node._take_image(camera, shot.message)

        for second in range(1, 3 + UNPAIRED):
            send(second, 0.05)
        message, values = problem(node)
        assert "differ by 50.0 ms, and --lag allows 16.7 ms" in message or "950.0 ms" in message
        assert int(values["dropped sets"]) >= UNPAIRED
        send(50, 0.004)
        for _ in range(600):
            if node._summary:
                break
            time.sleep(0.1)
        node.slot.stop()
        message, values = problem(node)
        assert message == "running"
        assert (values["sets"], values["lag (ms)"]) == ("1", "4.0")
        assert values["last image"].startswith("1 part: 2 of 2 views")
    finally:
        rclpy.try_shutdown()
