"""Estimators, scenes and images that several tests of inference share."""

import cv2
import numpy as np
import pytest

from dopepp import PoseEstimator
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory


@pytest.fixture(scope="session")
def piv_estimator():
    return PoseEstimator.load("pretrained/pivconnector")


@pytest.fixture(scope="session")
def estimator():
    """An estimator with the pretrained wide network."""
    return PoseEstimator.load("pretrained/pivconnector_wide", refine="region")


@pytest.fixture(scope="session")
def piv_render():
    """A render of the part that the pretrained network detects."""
    return Factory([pivconnector()], PRESETS["quickstart"].reframed(320, 240), 2).render(0, 9)


@pytest.fixture(scope="session")
def scene():
    """A scene with the part that the pretrained wide network detects."""
    return Factory([pivconnector()], PRESETS["wide"].reframed(640, 480), 4177).scene(0, 0)


@pytest.fixture(scope="session")
def write_clip():
    """Write a video of RGB images, ten per second."""

    def write(path, images, codec="MJPG"):
        size = images[0].shape[1::-1]
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10.0, size)
        for image in images:
            writer.write(np.ascontiguousarray(image[..., ::-1]))
        writer.release()
        return path

    return write
