"""Look-alikes of parts, and the distance from the mirror image."""

import numpy as np
import pytest
import trimesh

from dopepp.geometry.rotation import random_rotation
from dopepp.parts.catalogue import pivconnector
from dopepp.parts.lookalikes import STRETCH, lookalikes, mirror_distance
from dopepp.parts.mesh import weld
from dopepp.parts.mesh.read import find_topology
from dopepp.parts.part import Mesh, make_part
from tests.parts.makers import mesh_of, solid_of


def box(size, at=(0, 0, 0)):
    body = trimesh.creation.box(size)
    body.apply_translation(at)
    return body


CHIRAL = mesh_of(
    box((0.10, 0.02, 0.02)), box((0.02, 0.06, 0.02), (0.04, 0.04, 0)),
    box((0.02, 0.02, 0.05), (-0.04, 0, 0.035)),
)  # fmt: skip
"""Three arms along x, y and z, which no rotation turns into their mirror image."""


@pytest.mark.parametrize(
    "body",
    [
        box((0.1, 0.06, 0.03)),
        trimesh.creation.cylinder(0.02, 0.1),
        trimesh.creation.cone(0.03, 0.1),
    ],
)
def test_symmetric_bodies_are_their_own_mirror_images_in_any_pose(body):
    mesh = mesh_of(body)
    rng = np.random.default_rng(0)
    turned = mesh.vertices @ random_rotation(rng).T + rng.normal(size=3)
    assert mirror_distance(Mesh(turned, mesh.faces)) < 0.01


def test_a_body_that_only_a_point_reflects_is_its_own_mirror_image():
    # A parallelepiped of unequal edges and angles has no mirror plane.
    edges = np.array([[0.1, 0.0, 0.0], [0.03, 0.07, 0.0], [0.02, 0.03, 0.05]])
    cube = mesh_of(box((1, 1, 1)))
    assert mirror_distance(Mesh(cube.vertices @ edges, cube.faces)) < 0.01


def test_a_symmetric_part_has_no_mirrored_copy():
    copies = lookalikes([make_part("body", mesh_of(box((0.1, 0.06, 0.03))))])
    assert [copy.name for copy in copies] == ["body, stretched", "body, cut"]


def test_a_chiral_part_has_a_mirrored_copy():
    part = make_part("arms", CHIRAL)
    mirrored, stretched, cut = copies = lookalikes([part])
    assert [copy.name for copy in copies] == ["arms, mirrored", "arms, stretched", "arms, cut"]
    volumes = [solid_of(each.mesh).volume for each in (part, mirrored, stretched, cut)]
    # A mirrored surface is not turned inside out; a stretched one grows along one side.
    assert volumes[1] == pytest.approx(volumes[0])
    assert volumes[2] == pytest.approx(STRETCH * volumes[0])
    assert 0.4 * volumes[0] < volumes[3] < 0.95 * volumes[0]
    sides = np.ptp(part.cuboid, axis=0) * (STRETCH, 1, 1)
    assert np.ptp(stretched.cuboid, axis=0) == pytest.approx(sides)
    assert mirrored.diameter == pytest.approx(part.diameter)
    assert len({each.mesh_hash for each in (part, mirrored, stretched, cut)}) == 4


def test_a_cut_copy_stays_closed_and_keeps_its_colours():
    part = pivconnector()
    colours = np.tile(np.array([[200, 30, 30]], np.uint8), (len(part.mesh.vertices), 1))
    coloured = Mesh(part.mesh.vertices, part.mesh.faces, colours=colours)
    cut = lookalikes([make_part("coloured", coloured)])[-1]
    np.testing.assert_array_equal(cut.mesh.colours, colours)
    assert find_topology(weld(cut.mesh.vertices, cut.mesh.faces)[1]).is_closed
    moved = np.linalg.norm(cut.mesh.vertices - part.mesh.vertices, axis=1)
    assert 0 < (moved > 0).mean() < 0.6
    assert moved.max() > 0.05 * part.diameter


def test_a_part_without_a_mesh_has_no_look_alike():
    points = np.random.default_rng(0).normal(size=(50, 3)) / 10
    assert lookalikes([make_part("points", None, points)]) == []
