"""Rendered images of a part, as messages of a camera's driver and as a recording."""

from types import SimpleNamespace

import numpy as np
import pytest

from dopepp.core.files import write_png
from dopepp.inference.estimator import PoseEstimator
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory
from tests.cli.conftest import refused, run  # noqa: F401

FRAME = "camera_optical_frame"
TOPIC = "/camera/image_raw"
LENS = [-0.05, 0.01, 0.001, -0.001, 0.0]


@pytest.fixture(scope="session")
def estimator():
    return PoseEstimator.load("pretrained/pivconnector")


@pytest.fixture(scope="session")
def camera(tmp_path_factory):
    """Images of a camera, its matrix, and a folder with the same images."""
    factory = Factory([pivconnector()], PRESETS["quickstart"].reframed(320, 240), 2)
    rendered = [factory.render(0, number) for number in (9, 10, 11)]
    folder = tmp_path_factory.mktemp("images")
    for number, item in enumerate(rendered):
        write_png(folder / f"{number}.png", item.image)
    images = [item.image for item in rendered]
    return SimpleNamespace(images=images, K=rendered[0].scene.K, folder=folder)


def header(second, frame_id=FRAME):
    stamp = SimpleNamespace(sec=int(second), nanosec=round(1e9 * (second % 1)))
    return SimpleNamespace(stamp=stamp, frame_id=frame_id)


def image_message(image, second, frame_id=FRAME):
    height, width = image.shape[:2]
    return SimpleNamespace(
        header=header(second, frame_id), height=height, width=width, encoding="rgb8",
        is_bigendian=0, step=3 * width, data=image.tobytes(),
    )  # fmt: skip


def info_message(K, size, **changes):
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    fields = {
        "header": header(1.0), "width": size[0], "height": size[1],
        "distortion_model": "plumb_bob", "d": LENS, "k": K.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(), "p": np.c_[K, np.zeros(3)].ravel().tolist(),
        "binning_x": 0, "binning_y": 0, "roi": roi,
    }  # fmt: skip
    return SimpleNamespace(**fields | changes)


@pytest.fixture
def warnings(monkeypatch):
    """Texts of the warnings that workers log."""
    texts = []
    monkeypatch.setattr("dopepp.robot.nodes.worker.logger.warning", texts.append)
    return texts


@pytest.fixture(scope="session")
def messages():
    return SimpleNamespace(image=image_message, info=info_message, topic=TOPIC, frame=FRAME)


@pytest.fixture(scope="session")
def recording(camera, tmp_path_factory):
    """Return a recording of ROS 2 whose first ``camera_info`` follows the first image."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    arrays = {bytes: lambda data: np.frombuffer(data, np.uint8), list: np.array}

    def native(kind, message):
        fields = {}
        for name, node in store.fielddefs[kind][1]:
            value = getattr(message, name)
            is_nested = node[0].name == "NAME"
            convert = arrays.get(type(value), lambda value: value)
            fields[name] = native(node[1], value) if is_nested else convert(value)
        return store.types[kind](**fields)

    folder = tmp_path_factory.mktemp("bag") / "run"
    plugin = rosbag2.StoragePlugin.MCAP
    with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as writer:
        topics = {}
        for topic, name in ((TOPIC, "Image"), ("/camera/camera_info", "CameraInfo")):
            kind = f"sensor_msgs/msg/{name}"
            topics[kind] = writer.add_connection(topic, kind, typestore=store)
        for number, image in enumerate(camera.images, 1):
            sent = image_message(image, number), info_message(camera.K, (320, 240))
            for (kind, connection), message in zip(topics.items(), sent, strict=True):
                content = store.serialize_cdr(native(kind, message), kind)
                writer.write(connection, number * 10**9, content)
    return next(folder.glob("*.mcap"))
