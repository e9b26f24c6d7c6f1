"""The next best view, and its expected error compared with sampled poses."""

import math

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.geometry.camera import (
    camera_matrix,
    invert_transform,
    make_transform,
    move_pose,
    transform,
)
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix
from dopepp.inference.refinement.outline import make_outline_mesh
from dopepp.inference.several_views.next_view import next_best_view, point_error
from dopepp.parts.catalogue import pivconnector

K, SIZE = camera_matrix(600.0, 600.0, 319.5, 239.5), (640, 480)
POSE = move_pose(np.eye(4), np.array([2.9, 0.2, 0.3, 0.01, 0, 0.25]))


@pytest.fixture(scope="module")
def mesh():
    part = pivconnector()
    return make_outline_mesh(part.mesh.vertices, part.mesh.faces)


def beside(degrees, axis=(0.0, 1.0, 0.0)):
    """Return T_world_cam of a camera rotated about the part by an angle."""
    turn = rotation_vector_to_matrix(math.radians(degrees) * np.array(axis))
    return invert_transform(make_transform(turn, POSE[:3, 3] - turn @ POSE[:3, 3]))


def along_the_ray(millimetres):
    """Return the covariance of a pose with a large error along the viewing ray."""
    ray = POSE[:3, 3] / np.linalg.norm(POSE[:3, 3])
    covariance = np.diag(np.repeat([math.radians(0.2), 1e-4], 3) ** 2)
    covariance[3:, 3:] += (1e-3 * millimetres) ** 2 * np.outer(ray, ray)
    return covariance


def test_view_from_the_side_is_better_than_the_same_view(mesh):
    views = np.array([beside(0), beside(10), beside(30)])  # the shape that the page states
    chosen = next_best_view(mesh, POSE, along_the_ray(1.4), views, K, SIZE)
    same, near, far = chosen.expected
    assert chosen.number == 2
    assert far < near < same <= chosen.before
    assert same > 0.4 * chosen.before  # scale and distance look alike
    assert far < 0.3 * chosen.before
    assert "1.4 to" in chosen.reason


def test_views_that_do_not_show_the_part_are_excluded(mesh):
    away = beside(0)
    away[0, 3] += 0.3
    below = np.diag([1.0, 1.0, -1.0, 1.0])  # the camera at the origin is under this bench
    below[2, 3] = -0.1
    views = [away, beside(20)]
    chosen = next_best_view(mesh, POSE, along_the_ray(1.4), views, K, SIZE)
    assert chosen.number == 1
    assert chosen.expected[0] == math.inf
    bench = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.3]))
    assert next_best_view(mesh, POSE, along_the_ray(3.0), views, K, SIZE, bench).number == 1
    with pytest.raises(UserError, match="no view of 2"):
        next_best_view(mesh, POSE, along_the_ray(3.0), views, K, SIZE, below)
    with pytest.raises(UserError, match="no view of 0"):
        next_best_view(mesh, POSE, along_the_ray(3.0), [], K, SIZE)


def test_point_error_is_the_rms_error_of_sampled_poses(mesh):
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(6, 6)) * np.repeat([0.01, 0.001], 3)[:, None]
    covariance, pose = spread @ spread.T, make_transform(random_rotation(rng), rng.normal(size=3))
    draws = [move_pose(pose, spread @ rng.normal(size=6)) for _ in range(4000)]
    at = transform(pose, mesh.vertices)
    squares = [((transform(draw, mesh.vertices) - at) ** 2).sum(axis=1).mean() for draw in draws]
    expected = math.sqrt(np.mean(squares))
    assert point_error(mesh, pose, covariance) == pytest.approx(expected, rel=0.05)
