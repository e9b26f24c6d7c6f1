"""Sizes of the network's input, and merging of their detections."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import cv2
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose

from dopepp.core.errors import UserError
from dopepp.geometry.camera import (
    Letterbox,
    camera_matrix,
    make_transform,
    project_keypoints,
    resize_camera,
    transform,
)
from dopepp.inference.network_input import (
    MARGIN,
    MAX_PIXELS,
    letterboxes,
    merge_scales,
    network_views,
)
from dopepp.parts.catalogue import load_part
from dopepp.parts.size import LearnedRange
from dopepp.recovery import Detection
from dopepp.virtual import PRESETS, Factory, render

SEEN = LearnedRange(48.0, 98.0, 0.12, 0.25)


def blank_image(width, height):
    return np.zeros((height, width, 3), np.uint8)


def checkpoint(diameter=0.1, seen=SEEN, **others):
    parts = [SimpleNamespace(name="part", diameter=diameter)]
    sizes = {} if seen is None else {"part": seen}
    return SimpleNamespace(parts=parts, input_size=(128, 128), seen=sizes, **others)


def boxes(size, focal, distances=None, **options):
    K = camera_matrix(focal, focal, size[0] / 2, size[1] / 2)
    return letterboxes(checkpoint(**options), blank_image(*size), K, distances)


def test_training_camera_uses_the_training_size():
    focal = 48.0 * 0.25 / 0.1
    for size, scale in (((128, 128), 1), ((256, 256), 2), ((100, 128), 1)):
        assert boxes(size, scale * focal) == [Letterbox.fit(size, (128, 128))]


@pytest.mark.parametrize("size", [(640, 480), (1920, 1080), (1080, 1920), (2592, 1944)])
def test_camera_with_more_pixels_shows_the_part_at_the_trained_size(size):
    focal = 120.0 * min(size) / 128
    (box,) = boxes(size, focal)
    assert 128 / MARGIN <= min(box.width, box.height) <= 1.03 * 128
    assert box.width / box.height == pytest.approx(size[0] / size[1], rel=0.02)


@pytest.mark.parametrize("focal", [450.0, 1200.0])
def test_the_size_of_training_images_is_a_further_view(focal):
    """With the longer focal length, it shows farther parts; with the shorter, nearer parts."""
    K, image = camera_matrix(focal, focal, 320, 240), blank_image(640, 480)
    expected, further = network_views(checkpoint(), 32, image, K)
    assert not expected.is_further
    assert further.is_further
    assert further.box == Letterbox.fit((640, 480), (128, 128))
    (stated,) = network_views(checkpoint(), 32, image, K, (0.12, 0.25))
    assert stated.box == expected.box


def test_windows_of_a_camera_are_no_further_view():
    """The whole image at the size of the training windows shows no part at a trained size."""
    seen, focal = LearnedRange(45.0, 120.0, 0.3, 0.8), 600.0
    K = camera_matrix(focal, focal, 320, 240)
    (view,) = network_views(checkpoint(seen=seen), 32, blank_image(640, 480), K)
    assert view.box.scale_x == pytest.approx(45.0 * 0.8 / (0.1 * focal), rel=1e-2)
    nearest_px = 128 / 640 * 0.1 * focal / seen.nearest
    assert nearest_px < seen.smallest_px


def test_checkpoint_without_trained_sizes_uses_its_input_size():
    assert boxes((640, 480), 600.0, seen=None) == [Letterbox.fit((640, 480), (128, 128))]


@given(st.floats(100, 3000), st.floats(0.05, 2), st.floats(1, 10), st.floats(0, 1))
def test_every_distance_has_an_image_at_a_trained_size(focal, near, ratio, share):
    far = near * ratio
    result = boxes((1280, 960), focal, (near, far))
    native = 0.1 * focal / (near * ratio**share)
    shown = [native * box.scale_x for box in result]
    fits = any(48 / MARGIN**2 <= item <= 98 * MARGIN**2 for item in shown)
    # The part is too far away for the largest allowed image.
    too_small = native * np.sqrt(MAX_PIXELS / (1280 * 960)) < 98 * MARGIN**2
    assert fits or too_small
    assert all(box.width * box.height <= 1.01 * MAX_PIXELS for box in result)


def test_any_distance_covers_all_detectable_sizes():
    result = boxes((640, 480), 600.0, "any")
    assert result[0].scale_x * 480 <= 98 * MARGIN
    assert result[-1].scale_x > 0.6
    assert all(b.scale_x > a.scale_x for a, b in pairwise(result))


@pytest.mark.parametrize("distances", [(0.5, 0.3), (0.0, 1.0), (0.1, np.inf), (0.1, 0.2, 0.3)])
def test_invalid_distances_are_rejected(distances):
    with pytest.raises(UserError, match="distances="):
        boxes((640, 480), 600.0, distances)


def detection(x, score, side=20.0, name="part"):
    corners = np.array([[x + dx, dy] for dx in (0, side) for dy in (0, side)] * 2)
    return SimpleNamespace(object=name, score=score, keypoints=np.vstack([corners, [x + 10, 10]]))


def test_best_detection_of_all_scales_is_kept():
    near, far = detection(0, 0.5), detection(100, 0.4)
    better, other = detection(4, 0.9), detection(3, 0.8, name="other")
    assert merge_scales([[near, far], [better, other]]) == [better, other, far]


def test_two_detections_of_one_scale_are_two_instances():
    first, two = detection(0, 0.5), detection(4, 0.4)
    assert merge_scales([[first, two], []]) == [first, two]


@pytest.fixture(scope="module")
def estimator(estimator):
    return estimator.refining(None)


@pytest.fixture(scope="module")
def scenes(estimator):
    preset = PRESETS["wide"].resized(*estimator.checkpoint.input_size)
    factory = Factory([load_part("pivconnector")], preset, 771)
    return [factory.scene(0, index) for index in range(12)]


def with_image_size(scene, size):
    """Return a scene for a camera of another image size and the same angle of the shorter side."""
    scale = min(size) / 128
    K = resize_camera(scene.K, scale, scale)
    K[:2, 2] = (np.array(size) - 1) / 2
    background = cv2.resize(scene.background, (max(size), max(size)))[: size[1], : size[0]]
    return replace(scene, K=K, background=np.ascontiguousarray(background))


def num_right(estimator, scenes):
    part, passed = estimator.parts[0], 0
    for scene in scenes:
        true = scene.objects[scene.targets[0]].T_cam_obj
        for detection in estimator.predict(render(scene).image, scene.K)[:1]:
            away = transform(detection.T_cam_obj, part.points) - transform(true, part.points)
            passed += np.linalg.norm(away, axis=1).mean() < 0.1 * part.diameter
    return passed


@pytest.fixture(scope="module")
def usual(estimator, scenes):
    """The number of right poses with the training camera."""
    return num_right(estimator, scenes)


@pytest.mark.parametrize("size", [(320, 240), (480, 853), (1280, 720)])
def test_other_cameras_detect_as_many_parts(estimator, scenes, usual, size):
    assert usual >= 5
    assert num_right(estimator, [with_image_size(scene, size) for scene in scenes]) >= usual - 2


def test_a_further_view_is_left_out_after_a_probable_detection(estimator, scenes, monkeypatch):
    scene, sizes = with_image_size(scenes[0], (640, 480)), []
    compute = estimator.maps

    def maps(pixels):
        sizes.append(pixels.shape[:2])
        return compute(pixels)

    monkeypatch.setattr(estimator, "maps", maps)
    assert estimator.predict(render(scene).image, scene.K)[0].score > 0.5
    assert sizes == [(128, 192)]
    estimator.predict(blank_image(640, 480), scene.K)
    assert sizes[1:] == [(128, 192), (96, 128)]


def test_farther_part_is_detected_with_a_farther_range(estimator, scenes):
    scene = with_image_size(scenes[0], (1280, 720))
    true = scene.objects[scene.targets[0]].T_cam_obj
    image, K = render(scene).image, scene.K
    # With three times the focal length, the same image shows a part three times as far away.
    K = K * np.array([[3.0], [3.0], [1.0]])
    K[:2, 2] = scene.K[:2, 2]

    for distances, expected in (((0.1, 0.15), False), ((0.4, 0.8), True), ("any", True)):
        found = estimator.predict(image, K, distances=distances)[:1]
        right = [abs(item.T_cam_obj[2, 3] / (3 * true[2, 3]) - 1) < 0.15 for item in found]
        assert any(right) == expected, distances


def test_region_is_processed_like_a_separate_image(estimator, scenes):
    image, K = render(scenes[0]).image, scenes[0].K
    canvas = np.full((300, 400, 3), 90, np.uint8)
    canvas[50:178, 70:198] = image
    shifted = K.copy()
    shifted[:2, 2] += 70, 50
    (alone,) = estimator.predict(image, K)
    (inside,) = estimator.predict(canvas, shifted, roi=(70, 50, 128, 128))
    assert np.allclose(inside.T_cam_obj, alone.T_cam_obj)
    assert np.allclose(inside.peaks, alone.peaks + np.array([70, 50]), equal_nan=True)
    assert np.allclose(inside.keypoints, alone.keypoints + np.array([70, 50]), equal_nan=True)


@pytest.mark.parametrize("roi", [(-1, 0, 10, 10), (0, 0, 200, 10), (5, 5, 0, 10)])
def test_region_outside_the_image_is_rejected(estimator, roi):
    with pytest.raises(UserError, match="roi"):
        estimator.predict(blank_image(128, 128), camera_matrix(110, 110, 63.5, 63.5), roi=roi)


def test_depths_of_a_view_show_the_part_at_trained_sizes():
    K = camera_matrix(600.0, 600.0, 320.0, 240.0)
    for view in network_views(checkpoint(diameter=0.1), 32, blank_image(640, 480), K):
        near, far = view.depths(SEEN, 0.1)
        largest, smallest = (view.K[0, 0] * 0.1 / depth for depth in (near, far))
        assert_allclose([largest / MARGIN, smallest * MARGIN], [98.0, 48.0])


def test_alternatives_are_expressed_in_pixels_of_the_image():
    cuboid = load_part("pivconnector").cuboid
    T, K = make_transform(np.eye(3), np.array([0.0, 0.0, 0.3])), camera_matrix(600, 600, 320, 240)
    region = network_views(checkpoint(), 32, blank_image(640, 480), K, roi=(40, 20, 320, 240))[0]
    keypoints = project_keypoints(cuboid, T, region.K)
    found = Detection("part", 0.1, 0.1, T, keypoints, keypoints, 2.0, np.eye(6))
    moved = region.to_image(replace(found, alternative=found), cuboid, K).alternative
    expected = project_keypoints(cuboid, T, K)
    assert_allclose(moved.keypoints, expected)
    assert_allclose(moved.peaks, expected)
    assert moved.reprojection_error_px == pytest.approx(2.0 * K[0, 0] / region.K[0, 0])
