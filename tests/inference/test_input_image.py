"""Checks and lens distortion of depth images."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix
from dopepp.inference.input_image import check_depth, read_depth_image, undistort_depth


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (np.ones((2, 3), np.float32), r"depth of shape \(2, 3\) for an image of 4×3"),
        (np.full((3, 4), 800, np.uint16), "depth of type uint16"),
        (np.full((3, 4), 800.0, np.float32), "median of 800 m.*divide by 1000"),
        (np.full((3, 4), -1.0, np.float32), "values down to -1"),
    ],
)
def test_impossible_depth_is_rejected(depth, message):
    with pytest.raises(UserError, match=message):
        check_depth(depth, (4, 3))
    unknown = np.array([[np.nan, np.inf], [0.0, 1.5]])
    assert_allclose(check_depth(unknown, (2, 2)), [[0, 0], [0, 1.5]])


def test_undistorted_depth_has_no_new_values():
    depth = np.where(np.arange(64) < 32, 0.5, 2.0).astype(np.float32)[None].repeat(48, axis=0)
    small = camera_matrix(60, 60, 31.5, 23.5)
    moved = undistort_depth(depth, small, np.array([-0.2, 0.05, 0, 0]))
    assert set(np.unique(moved)) <= {0.0, 0.5, 2.0}


def test_read_depth(tmp_path):
    path = tmp_path / "depth.png"
    cv2.imwrite(str(path), np.array([[0, 1000], [250, 65535]], np.uint16))
    assert_allclose(read_depth_image(path, 0.001), [[0, 1], [0.25, 65.535]])
    with pytest.raises(UserError, match="depth scale 0"):
        read_depth_image(path, 0.0)
    cv2.imwrite(str(path), np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(UserError, match="16 bits"):
        read_depth_image(path, 0.001)
