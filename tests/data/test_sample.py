from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.data.sample import (
    Instance,
    Sample,
    letterbox_sample,
    pad_sample,
    resize_sample,
)
from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints


def dot_sample(size: tuple[int, int], dot: tuple[float, float]) -> Sample:
    """An image of a smooth bright dot, which is also the first keypoint."""
    rows, columns = np.mgrid[: size[1], : size[0]]
    sigma = max(size) / 40
    value = 255 * np.exp(-((columns - dot[0]) ** 2 + (rows - dot[1]) ** 2) / (2 * sigma**2))
    image = np.repeat(np.rint(value).astype(np.uint8)[..., None], 3, axis=2)
    keypoints = np.tile(np.array(dot), (9, 1))
    mask = value > 100
    instance = Instance("dot", np.eye(4), keypoints, 1.0, mask)
    depth = np.where(mask, 0.5, 0).astype(np.float32)
    return Sample(image, np.eye(3), [instance], depth)


@given(
    x=st.floats(0.25, 0.75),
    y=st.floats(0.25, 0.75),
    size=st.sampled_from([(640, 480), (480, 640), (300, 200), (100, 100)]),
    target=st.sampled_from([(416, 416), (128, 128), (256, 160), (416, 96)]),
)
def test_a_bright_dot_moves_with_its_keypoint(x, y, size, target):
    sample = dot_sample(size, (x * size[0], y * size[1]))
    result = letterbox_sample(sample, target)
    assert result.size == target
    weights = result.image[..., 0].astype(float)
    rows, columns = np.mgrid[: target[1], : target[0]]
    centre = np.array([(columns * weights).sum(), (rows * weights).sum()]) / weights.sum()
    instance = result.instances[0]
    np.testing.assert_allclose(instance.keypoints[0], centre, atol=0.1)
    np.testing.assert_array_equal(result.depth > 0, instance.mask)
    mask_centre = np.argwhere(instance.mask).mean(axis=0)[::-1]
    scale = min(target[0] / size[0], target[1] / size[1])
    np.testing.assert_allclose(mask_centre, centre, atol=0.6 * max(1, scale))


@given(width=st.integers(50, 700), height=st.integers(50, 700), side=st.sampled_from([128, 416]))
def test_keypoints_and_camera_follow_one_rule(width, height, side):
    K = np.array([[1.1 * width, 0, 0.4 * width], [0, 1.2 * width, 0.6 * height], [0, 0, 1]])
    T = np.eye(4)
    T[:3, 3] = (0.01, -0.02, 0.4)
    cuboid = cuboid_keypoints(np.full(3, -0.04), np.full(3, 0.05))
    instance = Instance("box", T, project_keypoints(cuboid, T, K))
    sample = Sample(np.zeros((height, width, 3), np.uint8), K, [instance])
    result = letterbox_sample(sample, (side, side))
    expected = project_keypoints(cuboid, T, result.K)
    np.testing.assert_allclose(result.instances[0].keypoints, expected, atol=1e-9)


def test_padding_is_zero_on_the_right_and_at_the_bottom(fake_source):
    sample = fake_source(size=(64, 48)).sample(0)
    result = letterbox_sample(sample, (64, 64))
    np.testing.assert_array_equal(result.image[:48], sample.image)
    assert not result.image[48:].any()
    np.testing.assert_array_equal(result.K, sample.K)
    assert resize_sample(result, (64, 64)) is result
    with pytest.raises(ValueError, match="negative"):
        pad_sample(sample, (32, 64))
    bare = replace(sample, instances=[replace(sample.instances[0], mask=None)])
    assert letterbox_sample(bare, (32, 32)).instances[0].mask is None
