"""Proposed grasps lie on opposite walls, within the gripper's opening."""

import numpy as np
import pytest
import trimesh

from dopepp.core.errors import UserError
from dopepp.parts.part import make_part
from dopepp.robot.grasping.grasps import propose_grasps
from tests.parts.makers import mesh_of


def part_of(solid):
    return make_part("solid", mesh_of(solid))


@pytest.mark.parametrize("extents", [(0.06, 0.03, 0.02), (0.12, 0.05, 0.007)])
def test_a_box_is_gripped_on_opposite_faces(extents):
    part = part_of(trimesh.creation.box(extents))
    result = propose_grasps(part, 12)
    assert len(result) >= 3
    for item in result:
        axis = int(np.abs(item.closing).argmax())
        assert abs(item.closing[axis]) > 0.999
        assert item.width == pytest.approx(extents[axis], abs=1e-6)
        assert abs(item.point[axis]) < 1e-6
        assert (np.abs(item.point) <= np.array(extents) / 2 + 1e-9).all()


def test_both_contacts_lie_on_the_surface_of_a_ring():
    inner, outer = 0.015, 0.03
    solid = trimesh.creation.annulus(inner, outer, 0.02, sections=64)
    for grasp in propose_grasps(part_of(solid), 16):
        contacts = grasp.point + np.outer((-0.5, 0.5), grasp.width * grasp.closing)
        radius, height = np.hypot(*contacts[:, :2].T), np.abs(contacts[:, 2])
        # Distance of each contact from the two cylinders and from the two flat sides.
        away = np.abs([radius - inner, radius - outer, height - 0.01]).min(axis=0)
        assert away.max() < 1e-4
        assert (height < 0.0101).all()
        assert ((radius > inner - 1e-4) & (radius < outer + 1e-4)).all()


def test_equal_seeds_propose_equal_grasps():
    part = part_of(trimesh.creation.box((0.06, 0.03, 0.02)))
    first, second = (propose_grasps(part, 6, seed=3) for _ in range(2))
    assert [grasp.point.tolist() for grasp in first] == [grasp.point.tolist() for grasp in second]


@pytest.mark.parametrize(
    "solid",
    [trimesh.creation.box((0.2, 0.2, 0.2)), trimesh.creation.icosphere(radius=0.06)],
    ids=["wide box", "wide ball"],
)
def test_a_part_wider_than_the_gripper_has_no_grasp(solid):
    with pytest.raises(UserError, match="on which no grasp was found"):
        propose_grasps(part_of(solid), 5)
