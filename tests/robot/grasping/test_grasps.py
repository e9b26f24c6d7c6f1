"""Files of grasps, and proposed grasps: on opposite walls, within the gripper's opening."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dopepp.core.errors import UserError
from dopepp.parts.catalogue import BUILTIN, load_part
from dopepp.parts.part import make_part
from dopepp.robot.grasping.grasps import (
    MAX_OPENING,
    Grasp,
    find_grasps,
    propose_grasps,
    read_grasps,
    write_grasps,
)
from tests.parts.makers import mesh_of

GOOD = "{point: [0, 0, 0], closing: [0, 1, 0], approach: [0, 0, -1], width: 0.05}"


@pytest.mark.parametrize("name", sorted(BUILTIN))
def test_built_in_parts_have_grasps_from_the_front(name):
    assert any(grasp.approach[2] < -0.9 for grasp in find_grasps(load_part(name)))


def test_written_grasps_are_read(part, tmp_path):
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    grasp = Grasp(np.array([0.01, -0.002, -3e-5]), rotation[0], rotation[1], 0.0333)
    part = replace(part, name="100234 #2")  # neither a number nor a comment
    write_grasps(tmp_path / "g.yaml", part, [grasp])
    (read,) = read_grasps(tmp_path / "g.yaml", part)
    for name in ("point", "closing", "approach", "width"):
        np.testing.assert_allclose(getattr(read, name), getattr(grasp, name), atol=2e-5)


@pytest.mark.parametrize("flipped", [False, True])
def test_the_tool_has_the_axes_of_the_grasp(flipped):
    grasp = Grasp(np.array([0.1, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0]), 0.05)
    T = grasp.T_obj_tool(flipped)
    np.testing.assert_allclose(T[:3, 0], [0, -1 if flipped else 1, 0])
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert grasp.opening == pytest.approx(0.062)
    assert Grasp(grasp.point, grasp.closing, grasp.approach, 0.08).opening == MAX_OPENING


def file_of(*grasps, part="pivconnector"):
    return f"{{part: {part}, grasps: [{', '.join(grasps)}]}}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "allowed: a mapping"),
        (file_of(GOOD, part="other"), "part: pivconnector"),
        (file_of(), "1 to 1000 grasps"),
        (file_of("3"), r"grasps\[0\]=3"),
        (file_of(GOOD, GOOD.replace("0.05", "0.2")), r"grasps\[1\].width=0.2"),
        (file_of(GOOD.replace("0.05", "-1")), "width=-1; allowed: a number from"),
        (file_of(GOOD.replace("0.05", "true")), "width=True"),
        (file_of(GOOD.replace("[0, 1, 0]", "[0, 1]")), "closing"),
        (file_of(GOOD.replace("[0, 1, 0]", "[0, 1, .nan]")), "nan"),
        (file_of(GOOD.replace("[0, 1, 0]", "[0, 0, 2]")), "right"),
        (file_of(GOOD.replace("[0, 1, 0]", "[0, 0, 0]")), "right"),
        (file_of(GOOD.replace("[0, 0, 0]", "[5, 0, 0]", 1)), "point"),
    ],
)
def test_an_invalid_file_is_rejected_with_the_field(part, tmp_path, text, message):
    (tmp_path / "g.yaml").write_text(text)
    with pytest.raises(UserError, match=f"(?s).*{message}"):
        read_grasps(tmp_path / "g.yaml", part)


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
