import math
import sys

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix, make_transform, transform
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix
from dopepp.inference.refinement.depth import DepthRefiner
from dopepp.inference.refinement.fit import make_prior, outline_terms
from dopepp.inference.refinement.view import (
    checked_depth,
    lay_over,
    read_depth,
    undistorted_depth,
    view_around,
)
from dopepp.inference.refinement.visible import surface_points, visible
from dopepp.parts.catalogue import pivconnector
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.virtual.body import make_body
from dopepp.virtual.renderers.raster.rasteriser import render
from dopepp.virtual.scene import Plane, Scene, SceneObject

pytest.importorskip("small_gicp")

K = camera_matrix(600, 600, 319.5, 239.5)
TILTED = rotation_vector_to_matrix(np.array([2.6, 0.3, 0.2]))
TRUE = make_transform(TILTED, np.array([0.03, -0.02, 0.6]))


@pytest.fixture(scope="module")
def box() -> Part:
    whole = trimesh.creation.box((0.164, 0.214, 0.072))
    return make_part("box", Mesh(np.array(whole.vertices), np.array(whole.faces, np.int32)))


def depth_of(part: Part, T: np.ndarray, seed: int = 0, wall: float = 0.9) -> np.ndarray:
    body = make_body(part, is_target=True)
    scene = Scene(
        K,
        np.zeros((480, 640, 3), np.uint8),
        (SceneObject(body.surface, T, part=part),),
        plane=Plane((0.0, 0.0, -1.0), -wall),
    )
    depth = render(scene).depth
    noise = np.random.default_rng(seed).normal(size=depth.shape)
    return (depth + 1e-3 * noise * (depth > 0)).astype(np.float32)


def started(T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    shift = rng.normal(size=3) * [0.25, 0.25, 1.0]
    shift *= 0.014 / np.linalg.norm(shift)
    axis = rng.normal(size=3)
    axis *= math.radians(4) / np.linalg.norm(axis)
    return make_transform(rotation_vector_to_matrix(axis) @ T[:3, :3], T[:3, 3] + shift)


def add(part: Part, one: np.ndarray, other: np.ndarray) -> float:
    points = transform(one, part.points) - transform(other, part.points)
    return float(np.linalg.norm(points, axis=1).mean())


@pytest.mark.parametrize("name", ["box", "plate"])
def test_finds_the_pose_from_14_mm_away(name, box):
    part = box if name == "box" else pivconnector()
    refiner, depth = DepthRefiner([part]), depth_of(part, TRUE)
    for seed in range(5):
        start = started(TRUE, np.random.default_rng(seed))
        refined = refiner.refine(part.name, start, depth, K)
        assert refined.reason == ""
        assert add(part, refined.T_cam_obj, TRUE) < 0.004
        assert add(part, refined.T_cam_obj, TRUE) < add(part, start, TRUE) / 2
        assert refined.covariance is not None
        assert np.linalg.eigvalsh(refined.covariance).min() > 0


def test_keeps_the_pose_when_depth_shows_something_else(box):
    start = started(TRUE, np.random.default_rng(0))
    refiner = DepthRefiner([box])
    wall = np.full((480, 640), 0.9, np.float32)
    nothing = np.zeros_like(wall)
    near = np.full_like(wall, 0.3)
    noise = np.random.default_rng(0).uniform(0.3, 1.5, wall.shape).astype(np.float32)
    for depth in (wall, nothing, near, noise):
        kept = refiner.refine("box", start, depth, K)
        assert kept.reason
        assert kept.covariance is None
        assert_allclose(kept.T_cam_obj, start)


def test_keeps_the_pose_that_the_image_is_sure_of():
    """Depth of the same plate 40 mm aside contradicts a pose known to a millimetre."""
    part, aside = pivconnector(), TRUE.copy()
    aside[0, 3] += 0.04
    sure = np.diag([1e-3] * 6) ** 2
    kept = DepthRefiner([part]).refine(part.name, TRUE, depth_of(part, aside), K, sure)
    assert np.linalg.norm(kept.T_cam_obj[:3, 3] - TRUE[:3, 3]) < 0.012


def test_outside_the_view_or_behind_the_camera(box):
    refiner, depth = DepthRefiner([box]), depth_of(box, TRUE)
    for x, z in ((5.0, 0.6), (0.0, -0.6), (0.0, 0.05)):
        off = make_transform(TILTED, np.array([x, 0.0, z]))
        assert refiner.refine("box", off, depth, K).reason


def test_a_part_of_few_points_is_kept():
    corners = np.stack(np.meshgrid(*[[-0.04, 0.04]] * 3), -1).reshape(-1, 3)
    refiner = DepthRefiner([make_part("few", None, corners)])
    depth = np.full((480, 640), 0.6, np.float32)
    assert "few surface points" in refiner.refine("few", TRUE, depth, K).reason


def test_without_the_extra(box, monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(UserError, match=r"without the package small_gicp.*dopepp\[depth\]"):
        DepthRefiner([box])


def test_visible_points_agree_with_the_drawn_depth(box):
    for part in (box, pivconnector()):
        surface = surface_points(part.points)
        right = []
        for seed in range(6):
            R = random_rotation(np.random.default_rng(seed))
            T = make_transform(R, np.array([0.01, 0.02, 0.6]))
            body = make_body(part, is_target=True)
            image = np.zeros((480, 640, 3), np.uint8)
            depth = render(Scene(K, image, (SceneObject(body.surface, T),))).depth
            points = transform(T, surface.points)
            u, v = np.rint(points[:, :2] / points[:, 2:] * 600 + [319.5, 239.5]).astype(int).T
            drawn = depth[v, u]
            truth = points[:, 2] < drawn + 1.5e-3
            right.append((visible(surface, T) == truth)[drawn > 0].mean())
        assert np.mean(right) > 0.85


def test_normals_of_a_thin_plate_are_those_of_its_faces():
    rng = np.random.default_rng(0)
    faces = rng.uniform(-0.04, 0.04, (2000, 2))
    points = np.column_stack([faces, np.repeat([-0.002, 0.002], 1000)])
    surface = surface_points(points)
    assert np.mean(np.abs(surface.normals[:, 2]) > 0.99) > 0.97
    assert_allclose(surface.spacing, math.sqrt(2 * 0.08**2 / 2000), rtol=0.15)


def test_outline_pulls_a_shifted_part_back(box):
    """Seen face on, the pull of the outline is the shift, and nothing where there is none."""
    T = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    depth, surface = depth_of(box, T), surface_points(box.points)
    for shift in (0.0, 0.006):
        off = T.copy()
        off[0, 3] += shift
        points = transform(off, surface.points)
        view = view_around(depth, K, points)
        assert view is not None
        overlay = lay_over(view, surface, visible(surface, off), off)
        assert overlay is not None
        H, g = outline_terms(view, overlay, off[:3, 3], surface.spacing, 0.02)
        moved = np.linalg.solve(H[3:5, 3:5], g[3:5])
        assert -2 * shift - 0.002 <= moved[0] <= 0.002 - shift / 2
        assert abs(moved[1]) < 0.002


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6))
def test_prior_measures_turns_and_shifts(values):
    turn, shift = np.array(values[:3]), np.array(values[3:])
    prior = make_prior(TRUE, 0.1)
    moved = make_transform(rotation_vector_to_matrix(turn) @ TRUE[:3, :3], TRUE[:3, 3] + shift)
    assert_allclose(prior.offset(moved), [*-turn, *-shift], atol=1e-9)
    assert np.linalg.eigvalsh(prior.information).min() > 0
    broken = make_prior(TRUE, 0.1, np.full((6, 6), np.nan))  # a covariance that is none
    assert_allclose(broken.information, prior.information)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (np.ones((2, 3), np.float32), r"depth of shape \(2, 3\) for an image of 4×3"),
        (np.full((3, 4), 800, np.uint16), "depth of type uint16"),
        (np.full((3, 4), 800.0, np.float32), "median of 800 m.*divide by 1000"),
        (np.full((3, 4), -1.0, np.float32), "values down to -1"),
    ],
)
def test_depth_that_cannot_be_right(depth, message):
    with pytest.raises(UserError, match=message):
        checked_depth(depth, (4, 3))
    unknown = np.array([[np.nan, np.inf], [0.0, 1.5]])
    assert_allclose(checked_depth(unknown, (2, 2)), [[0, 0], [0, 1.5]])


def test_depth_is_undistorted_without_mixing():
    depth = np.where(np.arange(64) < 32, 0.5, 2.0).astype(np.float32)[None].repeat(48, axis=0)
    small = camera_matrix(60, 60, 31.5, 23.5)
    moved = undistorted_depth(depth, small, np.array([-0.2, 0.05, 0, 0]))
    assert set(np.unique(moved)) <= {0.0, 0.5, 2.0}


def test_read_depth(tmp_path):
    path = tmp_path / "depth.png"
    cv2.imwrite(str(path), np.array([[0, 1000], [250, 65535]], np.uint16))
    assert_allclose(read_depth(path, 0.001), [[0, 1], [0.25, 65.535]])
    with pytest.raises(UserError, match="depth scale 0"):
        read_depth(path, 0.0)
    cv2.imwrite(str(path), np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(UserError, match="16 bits"):
        read_depth(path, 0.001)
