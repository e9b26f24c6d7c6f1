"""The joint solver against least squares of SciPy, on keypoints instead of outlines."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from dopepp.geometry.camera import (
    camera_matrix,
    invert_transform,
    make_transform,
    move_pose,
    project,
    step_between,
    transform,
)
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix
from dopepp.inference.refinement.joint_refinement import PosedImage, ViewTerm, rotate_covariance
from dopepp.inference.refinement.solver import Prior, descend

K = camera_matrix(600.0, 600.0, 319.5, 239.5)
POINTS = 0.03 * np.random.default_rng(0).normal(size=(12, 3))
WEAK = np.eye(6) * 1e-3
NOISE_PX = 0.3
ERROR = np.diag(np.repeat([math.radians(0.05), 3e-4], 3) ** 2)
BLANK = np.zeros((4, 4, 3), np.uint8)


class Keypoints:
    """Points of a part that a camera has measured."""

    def __init__(self, pixels):
        self.pixels = pixels

    def __call__(self, pose, prior):
        def residuals(step):
            shown = project(transform(move_pose(pose, step), POINTS), K)
            return ((self.pixels - shown) / NOISE_PX).ravel()

        rest = residuals(np.zeros(6))
        rows = np.column_stack([(rest - residuals(1e-6 * axis)) / 1e-6 for axis in np.eye(6)])
        return rows.T @ rows, rows.T @ rest


def scene(seed, error, num_views=2):
    """Return the true pose in the world, the views and their measured keypoints."""
    rng = np.random.default_rng(seed)
    true = make_transform(random_rotation(rng), rng.normal(size=3))
    views, pixels = [], []
    for number in range(num_views):
        turn = rotation_vector_to_matrix(np.array([0.1, math.radians(25) * number, 0.0]))
        R = turn @ random_rotation(np.random.default_rng(1))
        T_cam_obj = make_transform(R, np.array([0.01, 0.02, 0.3]))
        T_cam_world = T_cam_obj @ invert_transform(true)
        measured = project(transform(T_cam_obj, POINTS), K)
        pixels.append(measured + NOISE_PX * rng.normal(size=measured.shape))
        # The camera is elsewhere than stated: T_cam_world is off by a draw of the error.
        draw = np.linalg.cholesky(error + 1e-30 * np.eye(6)) @ rng.normal(size=6)
        off = move_pose(np.eye(4), draw)
        views.append(PosedImage(BLANK, K, invert_transform(off) @ T_cam_world, error))
    return true, views, pixels


def joint(true, views, pixels):
    start = move_pose(true, np.array([0.02, -0.03, 0.01, 0.002, 0.001, -0.003]))
    terms = [ViewTerm(Keypoints(px), view) for px, view in zip(pixels, views, strict=True)]
    return descend(start, Prior(start, WEAK), terms, 12)


def by_scipy(true, views, pixels, error):
    """Estimate pose and camera errors together; return pose and covariance."""
    whiten = np.linalg.inv(np.linalg.cholesky(error))

    def residuals(unknowns):
        pose, rest = move_pose(true, unknowns[:6]), []
        for number, (view, px) in enumerate(zip(views, pixels, strict=True)):
            step = unknowns[6 + 6 * number : 12 + 6 * number]
            T_cam_obj = move_pose(np.eye(4), step) @ view.T_cam_world @ pose
            away = project(transform(T_cam_obj, POINTS), K) - px
            rest += [(away / NOISE_PX).ravel(), whiten @ step]
        return np.concatenate(rest)

    scale = np.concatenate([np.full(3, 1e-3), np.full(3, 1e-4)] * (1 + len(views)))
    start = np.zeros(6 + 6 * len(views))
    solved = least_squares(residuals, start, x_scale=scale, xtol=1e-14, ftol=1e-14)
    covariance = np.linalg.inv(solved.jac.T @ solved.jac)[:6, :6]
    return move_pose(true, solved.x[:6]), covariance


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("num_views", [1, 2, 3])
def test_the_solution_is_that_of_least_squares_with_camera_errors(seed, num_views):
    true, views, pixels = scene(seed, ERROR, num_views)
    end = joint(true, views, pixels)
    pose, covariance = by_scipy(true, views, pixels, ERROR)
    deviations = np.sqrt(np.diag(covariance))
    assert_allclose(step_between(pose, end.T_cam_obj) / deviations, np.zeros(6), atol=0.03)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    assert_allclose(whiten @ np.linalg.inv(end.information) @ whiten.T, np.eye(6), atol=0.03)


def test_the_covariance_is_that_of_the_errors():
    squared = []
    for seed in range(150):
        true, views, pixels = scene(seed, ERROR)
        end = joint(true, views, pixels)
        step = step_between(end.T_cam_obj, true)
        squared.append(step @ end.information @ step)
    assert np.mean(squared) / 6 == pytest.approx(1.0, abs=0.12)  # three standard errors


def test_a_covariance_returns_from_the_world():
    true, (view, _), _ = scene(0, 0 * ERROR)
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-6
    pose = view.to_world(view.pose(true), covariance)
    in_world = np.linalg.inv(pose.information)
    assert_allclose(pose.T_cam_obj, true, atol=1e-12)
    information = view.to_camera(true, in_world).information
    assert_allclose(np.linalg.inv(information), covariance, atol=1e-15)
    assert_allclose(in_world, rotate_covariance(view.T_cam_world[:3, :3].T, covariance), atol=1e-15)
