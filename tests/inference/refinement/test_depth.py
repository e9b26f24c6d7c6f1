import math
from functools import cache

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from dopepp.geometry.camera import camera_matrix, make_transform, move_pose, transform
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix
from dopepp.inference.refinement.depth import DepthEvidence
from dopepp.inference.refinement.depth.terms import outline_terms, plane_terms
from dopepp.inference.refinement.part_surface import (
    overlay_surface,
    surface_points,
    view_around,
    visible,
)
from dopepp.inference.refinement.refiner import PartRefiner
from dopepp.inference.refinement.solver import make_prior
from dopepp.parts.catalogue import pivconnector
from dopepp.parts.part import make_part
from dopepp.virtual.body import make_body
from dopepp.virtual.renderers.raster import render
from dopepp.virtual.scene import Plane, Scene, SceneObject
from tests.parts.makers import mesh_of

K = camera_matrix(600, 600, 319.5, 239.5)
TILTED = rotation_vector_to_matrix(np.array([2.6, 0.3, 0.2]))
TRUE = make_transform(TILTED, np.array([0.03, -0.02, 0.6]))
FACING = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
BLACK = np.zeros((480, 640, 3), np.uint8)


BOX = make_part("box", mesh_of(trimesh.creation.box((0.164, 0.214, 0.072))))


@pytest.fixture
def box():
    return BOX


def seen(part, T):
    """Return image and noisy depth of a part before a wall."""
    image, depth = rendered(part.name, tuple(T.ravel()))
    return image.copy(), depth.copy()


@cache
def rendered(name, pose):
    part, T = BOX if name == "box" else pivconnector(), np.reshape(pose, (4, 4))
    body = make_body(part, is_target=True)
    objects, plane = (SceneObject(body.surface, T, part=part),), Plane((0.0, 0.0, -1.0), -0.9)
    shown = render(Scene(K, np.full_like(BLACK, (40, 110, 60)), objects, plane=plane))
    depth = shown.depth
    noise = np.random.default_rng(0).normal(size=depth.shape)
    return shown.image, (depth + 1e-3 * noise * (depth > 0)).astype(np.float32)


def depth_of(part, T):
    return seen(part, T)[1]


def started(T, rng):
    shift, axis = rng.normal(size=3) * [0.25, 0.25, 1.0], rng.normal(size=3)
    shift *= 0.014 / np.linalg.norm(shift)
    axis *= math.radians(4) / np.linalg.norm(axis)
    return move_pose(T, np.concatenate([axis, shift]))


def moved(T, z=0.0, x=0.0):
    return move_pose(T, np.array([0, 0, 0, x, 0, z]))


def add(part, one, other):
    points = transform(one, part.points) - transform(other, part.points)
    return float(np.linalg.norm(points, axis=1).mean())


@pytest.mark.parametrize("name", ["box", "plate"])
def test_finds_the_pose_from_14_mm_away(name, box):
    part = box if name == "box" else pivconnector()
    refiner, depth = PartRefiner(part, ["depth"]), depth_of(part, TRUE)
    for seed in range(5):
        start = started(TRUE, np.random.default_rng(seed))
        refined = refiner.refine(BLACK, K, start, depth=depth)
        assert refined.reason == ""
        assert add(part, refined.T_cam_obj, TRUE) < 0.004
        assert add(part, refined.T_cam_obj, TRUE) < add(part, start, TRUE) / 2
        assert np.linalg.eigvalsh(refined.covariance).min() > 0


def test_keeps_the_pose_when_depth_shows_something_else(box):
    start = started(TRUE, np.random.default_rng(0))
    refiner = PartRefiner(box, ["depth"])
    wall, nothing, near = (np.full((480, 640), z, np.float32) for z in (0.9, 0.0, 0.3))
    noise = np.random.default_rng(0).uniform(0.3, 1.5, wall.shape).astype(np.float32)
    for depth in (wall, nothing, near, noise, None):
        kept = refiner.refine(BLACK, K, start, depth=depth)
        assert kept.reason
        assert kept.covariance is None
        assert_allclose(kept.T_cam_obj, start)


def test_keeps_the_pose_that_the_image_is_sure_of():
    """Depth of the same plate 40 mm aside contradicts a pose known to a millimetre."""
    part, sure = pivconnector(), np.diag([1e-3] * 6) ** 2
    depth = depth_of(part, moved(TRUE, x=0.04))
    kept = PartRefiner(part, ["depth"]).refine(BLACK, K, TRUE, sure, depth)
    assert np.linalg.norm(kept.T_cam_obj[:3, 3] - TRUE[:3, 3]) < 0.012


def test_outside_the_view_or_behind_the_camera(box):
    refiner, depth = PartRefiner(box, ["depth"]), depth_of(box, TRUE)
    for x, z in ((5.0, 0.6), (0.0, -0.6), (0.0, 0.05), (np.nan, 0.6)):
        off = make_transform(TILTED, np.array([x, 0.0, z]))
        assert refiner.refine(BLACK, K, off, depth=depth).reason


def test_a_part_of_few_points_is_kept():
    corners = np.stack(np.meshgrid(*[[-0.04, 0.04]] * 3), -1).reshape(-1, 3)
    refiner = PartRefiner(make_part("few", None, corners), ["depth"])
    depth = np.full((480, 640), 0.6, np.float32)
    assert "few surface points" in refiner.refine(BLACK, K, TRUE, depth=depth).reason


@pytest.mark.parametrize(
    ("picture", "measured", "better"),
    # The scale of an image alone may be off by 1 % of 0.6 m.
    [(True, True, 0.001), (True, False, 0.008), (False, True, 0.003)],
)
def test_picture_and_depth_refine_in_one_and_each_without_the_other(picture, measured, better):
    part = pivconnector()
    image, depth = seen(part, TRUE)
    refiner = PartRefiner(part, ["region", "depth"])
    for seed in range(3):
        start = started(TRUE, np.random.default_rng(seed))
        shown, known = image if picture else BLACK, depth if measured else None
        refined = refiner.refine(shown, K, start, depth=known)
        assert refined.reason == ""
        assert (refined.agreement is not None) == picture
        assert add(part, refined.T_cam_obj, TRUE) < better


def test_depth_is_followed_where_the_outline_is_too_large():
    """A print or a focal length that is off by 4 % makes the image put the part too near."""
    part = pivconnector()
    nearer = TRUE.copy()
    nearer[:3, 3] *= 0.96
    image, depth = seen(part, nearer)[0], seen(part, TRUE)[1]
    picture, both = (PartRefiner(part, terms) for terms in (["region"], ["region", "depth"]))
    for seed in range(3):
        start = started(TRUE, np.random.default_rng(seed))
        assert picture.refine(image, K, start).T_cam_obj[2, 3] < 0.98 * TRUE[2, 3]
        refined = both.refine(image, K, start, depth=depth)
        assert refined.reason == ""
        assert add(part, refined.T_cam_obj, TRUE) < 1e-3


def test_planes_pull_by_what_is_measured_on_the_part(box):
    """Of a face that lies 4 mm too far, the step is that, whatever hides it."""
    off = moved(FACING, z=0.004)
    surface, depth = surface_points(box.points), depth_of(box, FACING)
    hidden, holes = depth.copy(), depth.copy()
    hidden[:, 290:330] = 0.4
    holes[:220] = 0.0
    for measured in (depth, hidden, holes):
        view = view_around(measured, K, transform(off, surface.points))
        overlay = overlay_surface(view, surface, visible(surface, off), off)
        H, g = plane_terms(view, overlay, off[:3, 3], 0.02)
        assert_allclose(H, H.T)
        step = np.linalg.solve(H + np.diag([1e-6] * 3 + [1e2] * 3), g)
        assert_allclose(step[5], -0.004, atol=3e-4)


def test_a_descent_depends_on_nothing_asked_before(box):
    depth, prior = depth_of(box, TRUE), make_prior(TRUE, box.diameter)
    surface = surface_points(box.points)
    fresh, asked = (DepthEvidence(surface, box.diameter, depth, K, prior) for _ in range(2))
    turned = TRUE @ make_transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))  # its other sides
    asked.information(turned, asked.visible(turned))
    assert_allclose(asked.descend().T_cam_obj, fresh.descend().T_cam_obj, rtol=0, atol=0)


def test_depth_is_as_sure_as_its_independent_errors(box):
    """A camera with so many more pixels knows a pose no better: their errors are alike."""
    depth = depth_of(box, FACING)
    surface, prior = surface_points(box.points), make_prior(FACING, box.diameter)
    end = DepthEvidence(surface, box.diameter, depth, K, prior).descend()
    fine = cv2.resize(depth, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    K_fine = camera_matrix(1200, 1200, 639.5, 479.5)
    again = DepthEvidence(surface, box.diameter, fine, K_fine, prior).descend()
    deviations = [np.sqrt(np.linalg.inv(item.information)[5, 5]) for item in (end, again)]
    assert_allclose(deviations[1], deviations[0], rtol=0.2)
    assert 5e-5 < deviations[0] < 5e-4


def test_visible_points_agree_with_the_drawn_depth(box):
    for part in (box, pivconnector()):
        surface = surface_points(part.points)
        right = []
        for seed in range(6):
            R = random_rotation(np.random.default_rng(seed))
            T = make_transform(R, np.array([0.01, 0.02, 0.6]))
            body = make_body(part, is_target=True)
            depth = render(Scene(K, BLACK, (SceneObject(body.surface, T),))).depth
            points = transform(T, surface.points)
            u, v = np.rint(points[:, :2] / points[:, 2:] * 600 + [319.5, 239.5]).astype(int).T
            drawn = depth[v, u]
            truth = points[:, 2] < drawn + 1.5e-3
            right.append((visible(surface, T) == truth)[drawn > 0].mean())
        assert np.mean(right) > 0.85


def test_points_beside_the_image_have_no_view():
    depth = np.ones((480, 640), np.float32)
    points = np.array([[-1.0, 0.0, 1.0], [-0.9, 0.1, 1.0]])
    for turned in (points, -points * [1, 1, -1], points[:, [1, 0, 2]]):
        assert view_around(depth, K, turned) is None


def test_normals_of_a_thin_plate_are_those_of_its_faces():
    rng = np.random.default_rng(0)
    faces = rng.uniform(-0.04, 0.04, (2000, 2))
    points = np.column_stack([faces, np.repeat([-0.002, 0.002], 1000)])
    surface = surface_points(points)
    assert np.mean(np.abs(surface.normals[:, 2]) > 0.99) > 0.97
    assert_allclose(surface.spacing, math.sqrt(2 * 0.08**2 / 2000), rtol=0.15)


def test_outline_pulls_a_shifted_part_back(box):
    """Seen face on, the pull of the outline is the shift, and nothing where there is none."""
    depth, surface = depth_of(box, FACING), surface_points(box.points)
    for shift in (0.0, 0.006):
        off = moved(FACING, x=shift)
        view = view_around(depth, K, transform(off, surface.points))
        overlay = overlay_surface(view, surface, visible(surface, off), off)
        H, g = outline_terms(view, overlay, off[:3, 3], 0.02)
        step = np.linalg.solve(H[3:5, 3:5], g[3:5])
        assert -2 * shift - 0.002 <= step[0] <= 0.002 - shift / 2
        assert abs(step[1]) < 0.002


@given(st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6))
def test_prior_measures_turns_and_shifts(step):
    prior = make_prior(TRUE, 0.1)
    assert_allclose(prior.offset(move_pose(TRUE, np.array(step))), -np.array(step), atol=1e-9)
    assert np.linalg.eigvalsh(prior.information).min() > 0
    broken = make_prior(TRUE, 0.1, np.full((6, 6), np.nan))  # a covariance that is none
    assert_allclose(broken.information, prior.information)
