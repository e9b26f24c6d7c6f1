"""``estimator.stream``: detections, tracks and times on images and videos."""

import time

import cv2
import numpy as np
import pytest

from dopepp import PoseEstimator
from dopepp.core.errors import UserError
from dopepp.inference.frames import CameraFrame, FrameSource
from dopepp.inference.stream import MAX_AGE_S


@pytest.fixture
def K(piv_render):  # noqa: N802
    return piv_render.scene.K


@pytest.fixture(scope="module")
def estimator():
    return PoseEstimator.load("pretrained/pivconnector", refine="region")


@pytest.fixture(scope="module")
def clip(piv_render, tmp_path_factory, write_clip):
    shifted = [np.roll(piv_render.image, shift, axis=1) for shift in range(4)]
    return write_clip(tmp_path_factory.mktemp("clip") / "clip.avi", shifted)


def test_stream_of_an_image_equals_predict(estimator, piv_render, K, tmp_path):
    image = piv_render.image
    cv2.imwrite(str(tmp_path / "a.png"), image[..., ::-1])
    (expected,) = estimator.predict(image, K)
    (result,) = estimator.stream(tmp_path / "a.png", K)
    np.testing.assert_array_equal(result.image, image)
    np.testing.assert_allclose(result.detections[0].T_cam_obj, expected.T_cam_obj)
    assert result.name == str(tmp_path / "a.png")
    assert (result.time, result.identities) == (None, None)
    assert list(result.speed) == ["pre", "network", "decode", "refine"]
    assert min(result.speed.values()) > 0
    (none,) = estimator.stream(tmp_path / "a.png", K, min_score=1.0)
    assert none.detections == []
    assert (none.num_weaker, none.min_score) == (1, 1.0)
    assert none.weaker == pytest.approx([expected.score])


def test_parts_are_tracked_through_a_video(estimator, clip, K):
    results = list(estimator.stream(clip, K, track=True))
    assert [frame.time for frame in results] == pytest.approx([0, 0.1, 0.2, 0.3])
    assert [list(result.identities) for result in results] == [[0]] * 4
    moved = [result.detections[0].keypoints[-1, 0] for result in results]
    assert 1 < moved[-1] - moved[0] < 4  # of three pixels; a tracker's first steps are careful
    assert [item.number for item in estimator.stream(clip, K, stride=3)] == [0, 3]


def test_track_starts_with_a_detection_above_the_threshold(estimator, clip, K):
    results = list(estimator.stream(clip, K, track=True, min_score=1.0))
    assert [result.detections for result in results] == [[]] * 4
    assert [result.num_weaker for result in results] == [1] * 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "neither --K nor --camera"),
        ({"K": np.eye(3), "camera": "cam.yaml"}, "--K and --camera"),
        ({"K": np.eye(3)}, "field of view"),
        ({"K": np.eye(3), "stride": 0}, "stride=0"),
        ({"K": np.eye(3), "min_score": 2}, "min_score=2"),
        ({"K": np.eye(3), "track": True, "roi": (0, 0, 9, 9)}, "leave out --track or --roi"),
        ({"K": np.eye(3), "depth": "d.png"}, "--depth with 4 images"),
    ],
)
def test_invalid_options_are_rejected(estimator, clip, options, message):
    with pytest.raises(UserError, match=message):
        list(estimator.stream(clip, **options))


class Numbered(FrameSource):
    """Source of equal frames that ends with an error."""

    name = stem = "numbered"

    def __init__(self, image, num_frames, is_live=False):
        self.image, self.num_frames, self.is_live = image, num_frames, is_live

    def frames(self, stride=1):
        for number in range(self.num_frames):
            yield CameraFrame(self.image, self.name, number)
        raise UserError("a damaged frame", "a frame", "repeat the recording")


def test_each_frame_of_a_source_has_its_own_result_until_an_error(estimator, piv_render, K):
    (expected,) = estimator.predict(piv_render.image, K)
    total = dict(estimator.spent_ms)
    results = estimator.stream(Numbered(piv_render.image, 3), K)
    for number in range(3):
        result = next(results)
        assert result.number == number
        np.testing.assert_array_equal(result.detections[0].T_cam_obj, expected.T_cam_obj)
        assert 0 < result.speed["network"] < 60_000
    with pytest.raises(UserError, match="a damaged frame"):
        next(results)
    assert estimator.spent_ms == total


@pytest.mark.parametrize(("is_live", "number"), [(False, 1), (True, 2)])
def test_a_slow_caller_receives_the_newest_frame_of_a_camera(
    estimator, piv_render, K, is_live, number
):
    results = estimator.stream(Numbered(piv_render.image, 9, is_live), K)
    assert next(results).number == 0
    time.sleep(2 * MAX_AGE_S)
    assert next(results).number == number
    results.close()
