"""Rendered images of a part, as messages of a camera's driver and as a recording."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

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


@dataclass
class CameraImages:
    """Images of a camera, its matrix, and a folder with the same images."""

    images: list[np.ndarray]
    K: np.ndarray
    folder: Path


@pytest.fixture(scope="session")
def estimator():
    return PoseEstimator.load("pretrained/pivconnector")


@pytest.fixture(scope="session")
def camera(tmp_path_factory):
    factory = Factory([pivconnector()], PRESETS["quickstart"].reframed(320, 240), 2)
    rendered = [factory.render(0, number) for number in (9, 10, 11)]
    folder = tmp_path_factory.mktemp("images")
    for number, item in enumerate(rendered):
        write_png(folder / f"{number}.png", item.image)
    return CameraImages([item.image for item in rendered], rendered[0].scene.K, folder)


def header(second: float, frame_id: str = FRAME) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=int(second), nanosec=round(1e9 * (second % 1)))
    return SimpleNamespace(stamp=stamp, frame_id=frame_id)


def image_message(image: np.ndarray, second: float, frame_id: str = FRAME) -> SimpleNamespace:
    height, width = image.shape[:2]
    return SimpleNamespace(
        header=header(second, frame_id), height=height, width=width, encoding="rgb8",
        is_bigendian=0, step=3 * width, data=image.tobytes(),
    )  # fmt: skip


def info_message(K: np.ndarray, size: tuple[int, int], **changes: Any) -> SimpleNamespace:
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    fields = {
        "header": header(1.0), "width": size[0], "height": size[1],
        "distortion_model": "plumb_bob", "d": LENS, "k": K.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(), "p": np.c_[K, np.zeros(3)].ravel().tolist(),
        "binning_x": 0, "binning_y": 0, "roi": roi,
    }  # fmt: skip
    return SimpleNamespace(**fields | changes)


@pytest.fixture(scope="session")
def messages():
    return SimpleNamespace(image=image_message, info=info_message, topic=TOPIC, frame=FRAME)


@pytest.fixture(scope="session")
def recording(camera, tmp_path_factory):
    """Return a recording of ROS 2 whose first ``camera_info`` follows the first image."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)

    def native(kind: str, message: Any) -> Any:
        fields = {}
        for name, node in store.fielddefs[kind][1]:
            value = getattr(message, name)
            if node[0].name == "NAME":
                value = native(node[1], value)
            elif isinstance(value, bytes):
                value = np.frombuffer(value, np.uint8)
            elif isinstance(value, list):
                value = np.array(value, np.float64)
            fields[name] = value
        return store.types[kind](**fields)

    folder = tmp_path_factory.mktemp("bag") / "run"
    plugin = rosbag2.StoragePlugin.MCAP
    with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as writer:
        kinds = {
            TOPIC: "sensor_msgs/msg/Image",
            "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
        }
        connections = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in kinds.items()
        }
        for number, image in enumerate(camera.images, 1):
            info = info_message(camera.K, (320, 240))
            for topic, message in zip(kinds, (image_message(image, number), info), strict=True):
                content = store.serialize_cdr(native(kinds[topic], message), kinds[topic])
                writer.write(connections[topic], number * 10**9, content)
    return next(folder.glob("*.mcap"))
