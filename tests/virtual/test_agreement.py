import math

import numpy as np
import pytest
from scipy.stats import spearmanr

from dopepp.geometry.camera import camera_matrix, make_transform
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.parts.catalogue import servoholder
from dopepp.virtual import Scene, SceneObject, render
from dopepp.virtual.agreement import agreement
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS


def test_agreement_falls_with_the_error_of_the_pose():
    factory = Factory([servoholder()], PRESETS["table"].resized(320, 240), 3)
    errors, values, right = [], [], []
    for index in range(4):
        rendered = factory.render(0, index)
        rng = np.random.default_rng(index)
        item = rendered.scene.objects[rendered.scene.targets[0]]
        K = rendered.scene.K
        right.append(agreement(rendered.image, K, item.T_cam_obj, item.surface))
        for _ in range(10):
            share, axis, shift = rng.random(), rng.normal(size=3), rng.normal(size=3)
            R = rotation_vector_to_matrix(axis / np.linalg.norm(axis) * math.radians(20) * share)
            shift *= 0.02 * share / np.linalg.norm(shift)
            T = make_transform(R @ item.T_cam_obj[:3, :3], item.T_cam_obj[:3, 3] + shift)
            errors.append(share)
            values.append(agreement(rendered.image, K, T, item.surface))
    assert spearmanr(errors, values).statistic < -0.5
    assert np.median(right) > np.median(values) + 0.1
    assert all(0 <= value <= 1 for value in values)


def test_opposite_errors_have_the_same_agreement(box_surface):
    def moved(x, y):
        return make_transform(np.eye(3), np.array([x, y, 0.51]))

    K = camera_matrix(500.0, 500.0, 159.5, 119.5)
    box = SceneObject(box_surface, moved(0, 0))
    image = render(Scene(K, np.full((240, 320, 3), 90, np.uint8), (box,))).image
    error = 0.75e-3  # metres, three quarters of a pixel
    for x, y in ((error, 0.0), (0.0, error), (error, error)):
        there, back = (agreement(image, K, moved(a, b), box_surface) for a, b in ((x, y), (-x, -y)))
        assert there == pytest.approx(back, rel=0.02)


def test_agreement_is_zero_in_an_empty_image_and_outside_the_image():
    item = Factory([servoholder()], PRESETS["paper"], 0).scene(0, 0).objects[0]
    K = PRESETS["paper"].K
    grey = np.full((480, 640, 3), 90, np.uint8)
    assert agreement(grey, K, item.T_cam_obj, item.surface) < 0.05
    for place in ((9.0, 0.0, 0.5), (0.0, 0.0, -0.5), (0.0, 0.0, 0.0)):
        T = make_transform(np.eye(3), np.array(place))
        assert agreement(grey, K, T, item.surface) == 0.0
