from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.data.rendered import RenderedSource
from dopepp.data.sample import Instance, Sample
from dopepp.data.transforms.jitter import CameraJitter
from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import random_rotation
from dopepp.parts.catalogue import load_part
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS
from dopepp.virtual.renderers import find_renderer
from tests.data.makers import assert_same


@pytest.fixture(scope="module")
def factory():
    return Factory([load_part("pivconnector")], PRESETS["quickstart"].resized(128, 96), seed=0)


def posed(rng: np.random.Generator) -> tuple[Sample, np.ndarray]:
    """Return a grey image of a camera with rectangular pixels, and its object's points."""
    K = np.array([[300.0, 0, 70], [0, 280, 40], [0, 0, 1]])
    T_cam_obj = make_transform(random_rotation(rng), np.array([0.02, -0.03, 0.6]))
    corners = rng.uniform(-0.05, 0.05, (9, 3))
    pixels, _ = cv2.projectPoints(corners, T_cam_obj[:3, :3], T_cam_obj[:3, 3], K, None)
    item = Instance("box", T_cam_obj, pixels[:, 0], 0.8)
    return Sample(np.full((96, 128, 3), 90, np.uint8), K, [item]), corners


@given(seed=st.integers(0, 2**31), roll=st.floats(0, 180), shift=st.floats(0, 0.4))
def test_keypoints_are_the_posed_points_of_the_new_camera(seed, roll, shift):
    rng = np.random.default_rng(seed)
    sample, points = posed(rng)
    seen = CameraJitter(roll, (0.5, 2.0), shift)(sample, rng)
    (detection,) = seen.instances
    rotation, place = detection.T_cam_obj[:3, :3], detection.T_cam_obj[:3, 3]
    expected, _ = cv2.projectPoints(points, rotation, place, seen.K, None)
    np.testing.assert_allclose(detection.keypoints, expected[:, 0], atol=1e-6)
    assert place[2] == pytest.approx(0.6)  # the camera rolls and zooms, it does not travel
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    assert seen.K[0, 1] == 0


def test_masks_are_those_of_the_scene_rendered_through_the_new_camera(factory):
    source, render = RenderedSource(factory, 10), find_renderer("raster")
    jitter, rolls = CameraJitter(roll_deg=60, zoom=(0.7, 1.4), shift=0.1), []
    for index in range(10):
        sample = source.sample(index)
        seen = jitter(sample, np.random.default_rng(index))
        turn = seen.instances[0].T_cam_obj @ np.linalg.inv(sample.instances[0].T_cam_obj)
        scene = factory.scene(0, index)
        objects = tuple(replace(o, T_cam_obj=turn @ o.T_cam_obj) for o in scene.objects)
        again = render(replace(scene, K=seen.K, objects=objects))
        for instance, number in zip(seen.instances, again.scene.targets, strict=True):
            expected = again.instances == number
            overlap = (instance.mask & expected).sum() / (instance.mask | expected).sum()
            assert overlap > 0.93
        rolls.append(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
    assert min(rolls) < -20
    assert max(rolls) > 20


def test_pixels_move_with_the_keypoints():
    rng = np.random.default_rng(0)
    for _ in range(20):
        sample, _ = posed(rng)
        place = rng.uniform((50, 35), (78, 60))
        sample.instances[0].keypoints[:] = place
        cv2.circle(sample.image, np.rint(place * 16).astype(int).tolist(), 64, (255,) * 3, -1, 8, 4)
        seen = CameraJitter(30, (0.8, 1.25), 0.05)(sample, rng)
        rows, columns = np.nonzero(seen.image[..., 0] > 172)
        expected = seen.instances[0].keypoints[0]
        np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=0.6)


def test_pixels_outside_the_image_are_not_visible():
    mask = np.zeros((100, 100), bool)
    mask[40:60, 90:100] = True
    item = Instance("box", np.eye(4), np.zeros((9, 2)), 0.5, mask)
    sample = Sample(np.zeros((100, 100, 3), np.uint8), np.eye(3), [item])
    fractions = set()
    for seed in range(40):
        (moved,) = CameraJitter(0, (1, 1), 0.1)(sample, np.random.default_rng(seed)).instances
        assert moved.visible_fraction == pytest.approx(0.5 * moved.mask.sum() / mask.sum())
        fractions.add(round(moved.visible_fraction, 1))
    assert fractions > {0.3, 0.4}
    assert sample.instances[0].mask.sum() == mask.sum()


def test_without_a_mask_the_cuboids_outline_determines_visibility():
    keypoints = np.array([[90.0, 40], [98, 40], [98, 60], [90, 60]] * 2 + [[94, 50]])
    point = Instance("box", np.eye(4), keypoints, 0.5)
    sample = Sample(np.zeros((100, 100, 3), np.uint8), np.eye(3), [point])
    for seed in range(20):
        (moved,) = CameraJitter(0, (1, 1), 0.1)(sample, np.random.default_rng(seed)).instances
        inside = np.clip(99.5 - moved.keypoints[0, 0], 0, 8) / 8
        assert moved.visible_fraction == pytest.approx(0.5 * inside, abs=1e-6)
        (zoomed,) = CameraJitter(0, (0.8, 0.8), 0)(sample, np.random.default_rng(seed)).instances
        assert zoomed.visible_fraction == pytest.approx(0.5, abs=1e-6)


def test_no_jitter_changes_nothing_but_the_depth(factory):
    sample = RenderedSource(factory, 1).sample(0)
    same = CameraJitter(roll_deg=0, zoom=(1, 1), shift=0)(sample, np.random.default_rng(0))
    assert_same(same, sample, T_atol=1e-12, px_atol=1e-9)
