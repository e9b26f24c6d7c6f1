"""The second view of a grasp: it shows the part, the arm reaches it, and it reduces the error."""

from functools import partial

import numpy as np
import pytest

from dopepp.geometry.camera import invert_transform, make_transform, project, transform
from dopepp.inference.refinement.outline import make_outline_mesh
from dopepp.inference.several_views.views_result import WorldDetection
from dopepp.robot.grasping.cell import TRAY
from dopepp.robot.grasping.rehearsal import SIZE, TRUE_K
from dopepp.robot.grasping.selection import choose_viewpoint

COVARIANCE = np.diag(np.repeat([np.radians(0.3), 1e-3], 3) ** 2)


@pytest.fixture
def choose(trials, scene):
    planner, K = trials._planner(scene), scene.calibrated.camera.K
    return partial(choose_viewpoint, planner, K, scene.joints)


@pytest.fixture(scope="module")
def mesh(part):
    return make_outline_mesh(part.mesh.vertices, part.mesh.faces)


def detection(T_base_obj):
    return WorldDetection("pivconnector", 0.9, 0.9, T_base_obj, COVARIANCE, [])


def test_the_second_camera_looks_at_the_part_from_another_side(trials, scene, choose, mesh):
    pose = scene.targets[0]
    joints, reason = choose([detection(pose)], mesh)
    first, second = (
        trials.arm.flange(each) @ scene.calibrated.knowledge.T_flange_cam
        for each in (scene.joints, joints)
    )
    centre = transform(pose, mesh.vertices.mean(axis=0))
    pixel = project(transform(invert_transform(second), centre[None]), TRUE_K)[0]
    assert np.abs(pixel - np.array(SIZE) / 2).max() < 60
    apart = np.degrees(np.arccos(first[:3, 2] @ second[:3, 2]))
    assert 10 < apart < 60
    assert reason.startswith(f"{apart:.0f}°")
    assert second[2, 3] > 0.1  # above the bench


def test_without_a_part_the_camera_looks_at_the_tray(trials, scene, choose, mesh):
    joints, reason = choose([], mesh)
    T_base_cam = trials.arm.flange(joints) @ scene.calibrated.knowledge.T_flange_cam
    ray = TRAY - T_base_cam[:3, 3]
    np.testing.assert_allclose(ray / np.linalg.norm(ray), T_base_cam[:3, 2], atol=0.02)
    assert "tray" in reason


def test_a_part_out_of_reach_has_no_second_view(choose, mesh):
    away = make_transform(np.eye(3), np.array([3.0, 3.0, 0.0]))
    assert choose([detection(away)], mesh) is None
