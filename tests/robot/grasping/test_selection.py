"""The part to pick: a probable pose, a good grasp, little on top, and no failed attempt before.

The second view shows the part, the arm reaches it, and it reduces the error.
"""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from dopepp.geometry.camera import invert_transform, make_transform, project, transform
from dopepp.inference.refinement.outline import make_outline_mesh
from dopepp.inference.several_views.views_result import WorldDetection
from dopepp.robot.grasping.cell import HOME, TRAY
from dopepp.robot.grasping.rehearsal import SIZE, TRUE_K
from dopepp.robot.grasping.selection import (
    EstimatedPart,
    choose_part,
    choose_viewpoint,
    covered_share,
    pick_score,
)

GRID = np.stack(np.meshgrid(np.arange(0, 0.1, 0.002), np.arange(0, 0.05, 0.002), [0.0]), -1)
PLATE = GRID.reshape(-1, 3)  # a flat plate of 100 × 50 mm, points 2 mm apart


def at(x, z):
    return make_transform(np.eye(3), np.array([x, 0.0, z]))


@pytest.mark.parametrize(("shift", "share"), [(0.0, 1.0), (0.05, 0.5), (0.08, 0.2), (0.2, 0.0)])
def test_the_covered_share_is_that_of_two_shifted_plates(shift, share):
    lower, upper = at(0.0, 0.0), at(shift, 0.01)
    # Points within 3 mm of the upper plate's edge count as covered.
    assert covered_share(lower, [upper], PLATE) == pytest.approx(share, abs=0.05)
    assert covered_share(upper, [lower], PLATE) == 0
    assert covered_share(lower, [], PLATE) == 0


def test_the_score_falls_with_each_of_its_four_reasons():
    best = pick_score(0.9, 0.8, 0.0, 0)
    assert best == pytest.approx(0.72)
    assert pick_score(0.9, 0.8, 0.25, 0) == pytest.approx(0.54)
    worse = pick_score(0.5, 0.8, 0, 0), pick_score(0.9, 0.4, 0, 0), pick_score(0.9, 0.8, 0, 1)
    assert max(worse) < best
    assert pick_score(0.9, 0.8, 1.0, 0) == 0


class FakePlanner:
    """Planner whose grasps have the quality that is listed for the height of the part, mm."""

    def __init__(self, **qualities):
        self.qualities = {int(name[1:]): quality for name, quality in qualities.items()}
        self.planned = []

    def plan(self, poses, grasps, start, unexplained=None):
        height = round(1000 * poses[0][2, 3])
        self.planned.append(height)
        quality = self.qualities.get(height)
        if unexplained is not None and unexplained.blocks(poses[0], 0.05):
            return None
        return None if quality is None else SimpleNamespace(quality=quality)


class Blocked:
    """Regions that block grasps of parts at the listed heights, mm."""

    def __init__(self, *heights):
        self.heights = heights

    def blocks(self, T_base_tool, opening):
        return round(1000 * T_base_tool[2, 3]) in self.heights


def choose(planner, parts, failed=(), unexplained=None):
    choice = choose_part(planner, parts, PLATE, [], HOME, failed, unexplained)
    return choice and choice.number


def test_the_upper_of_two_parts_is_chosen_unless_its_pose_is_unlikely_or_it_has_no_grasp():
    lower, upper = EstimatedPart(at(0.0, 0.0), 0.9), EstimatedPart(at(0.02, 0.01), 0.9)
    planner = FakePlanner(z0=1.0, z10=0.9)
    assert choose(planner, [lower, upper]) == 1
    assert planner.planned == [10]  # the covered part cannot score more
    assert choose(planner, [lower, EstimatedPart(upper.T_base_obj, 0.05)]) == 0
    assert choose(FakePlanner(z0=1.0), [lower, upper]) == 0
    assert choose(FakePlanner(), [lower, upper]) is None


def test_a_part_that_was_not_grasped_is_tried_after_the_others_until_it_moves():
    parts = [EstimatedPart(at(0.0, 0.0)), EstimatedPart(at(0.3, 0.001), 0.8)]
    planner = FakePlanner(z0=1.0, z1=1.0)
    assert choose(planner, parts) == 0
    assert choose(planner, parts, [at(0.002, 0.0)]) == 1
    assert choose(planner, parts, [at(0.02, 0.0)]) == 0


def test_a_part_beside_an_unexplained_region_is_chosen_last():
    lower, upper = EstimatedPart(at(0.0, 0.0)), EstimatedPart(at(0.3, 0.001))
    planner = FakePlanner(z0=1.0, z1=0.5)
    assert choose(planner, [lower, upper], unexplained=Blocked()) == 0
    assert choose(planner, [lower, upper], unexplained=Blocked(0)) == 1
    assert (
        choose(planner, [lower, upper], unexplained=Blocked(0, 1)) == 0
    )  # there is no other grasp


COVARIANCE = np.diag(np.repeat([np.radians(0.3), 1e-3], 3) ** 2)


@pytest.fixture(scope="module")
def choose_view(trials, scene):
    planner, K = trials._planner(scene), scene.calibrated.camera.K
    return partial(choose_viewpoint, planner, K, scene.joints)


@pytest.fixture(scope="module")
def mesh(part):
    return make_outline_mesh(part.mesh.vertices, part.mesh.faces)


def detection(T_base_obj):
    return WorldDetection("pivconnector", 0.9, 0.9, T_base_obj, COVARIANCE, [])


def test_the_second_camera_looks_at_the_part_from_another_side(trials, scene, choose_view, mesh):
    pose = scene.targets[0]
    joints, reason = choose_view([detection(pose)], mesh)
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


def test_without_a_part_the_camera_looks_at_the_tray(trials, scene, choose_view, mesh):
    joints, reason = choose_view([], mesh)
    T_base_cam = trials.arm.flange(joints) @ scene.calibrated.knowledge.T_flange_cam
    ray = TRAY - T_base_cam[:3, 3]
    np.testing.assert_allclose(ray / np.linalg.norm(ray), T_base_cam[:3, 2], atol=0.02)
    assert "tray" in reason


def test_a_part_out_of_reach_has_no_second_view(choose_view, mesh):
    away = make_transform(np.eye(3), np.array([3.0, 3.0, 0.0]))
    assert choose_view([detection(away)], mesh) is None
