from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dopepp.core.errors import UserError
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts import Mesh, make_part, servoholder
from tests.parts.makers import mesh_of


def box(size):
    return mesh_of(trimesh.creation.box(size))


def test_measures_a_box():
    part = make_part("box", box((0.03, 0.04, 0.12)))
    assert (part.name, part.diameter) == ("box", pytest.approx(0.13, rel=1e-15))
    half = np.array([0.015, 0.02, 0.06])
    np.testing.assert_allclose(part.cuboid, cuboid_keypoints(-half, half), atol=1e-18)
    assert part.points.shape == (2000, 3)
    assert (part.symmetries_discrete, part.symmetries_continuous) == (None, ())


def test_points_alone_make_a_part_without_mesh():
    points = np.array([[0, 0, 0], [0.03, 0, 0], [0.03, 0.04, 0], [0.0, 0.04, 0.1]])
    np.testing.assert_array_equal(make_part("box", box((0.1, 0.1, 0.1)), points).points, points)
    with pytest.raises(ValueError, match="a mesh or points"):
        make_part("nothing", None)
    part = make_part("cloud", None, points)
    assert (part.mesh, part.mesh_hash) == (None, "")
    assert part.diameter == pytest.approx(np.linalg.norm([0.03, 0.04, 0.1]))
    np.testing.assert_allclose(part.cuboid[8], [0.015, 0.02, 0.05])


def test_different_meshes_have_different_hashes():
    mesh = box((0.1, 0.1, 0.1))
    moved = Mesh(np.nextafter(mesh.vertices, 1), mesh.faces)
    turned = Mesh(mesh.vertices, mesh.faces[:, [1, 2, 0]])
    hashes = {make_part("box", m).mesh_hash for m in (mesh, moved, turned)}
    assert list(map(len, hashes)) == [64] * 3
    assert make_part("other", box((0.1, 0.1, 0.1))).mesh_hash in hashes


@pytest.mark.parametrize(
    ("scale", "unit", "message"),
    [
        (1000, "m", r"'holder' with a diameter of 104\.8 m, .* unit=m; .*5 mm – 5 m; .*unit=mm"),
        (0.001, "mm", r"diameter of 0\.0001048 m, .* unit=mm; .* fix: .*unit=m$"),
        (0.01, "mm", r"diameter of 0\.001048 m, .* fix: .*unit=cm"),
        (0.0, "mm", r"diameter of 0 m, .* fix: export the part at its real size"),
    ],
)
def test_an_unlikely_size_names_the_unit_and_suggests_one(scale, unit, message):
    mesh = servoholder().mesh
    with pytest.raises(UserError, match=message):
        make_part("holder", Mesh(scale * mesh.vertices, mesh.faces), unit=unit)


@pytest.mark.parametrize("name", ["", "x" * 201, "two\nlines"])
def test_a_name_must_be_printable(name):
    with pytest.raises(UserError, match=r"part name .* printable characters"):
        make_part(name, box((0.1, 0.1, 0.1)))


def test_shapes_are_compared_independently_of_their_triangles():
    solid = trimesh.creation.box((0.1, 0.06, 0.02))
    thinner = trimesh.creation.box((0.1, 0.06, 0.019))
    solids = (solid, solid.subdivide(), solid.copy().apply_scale(1.005), thinner)
    part, finer, other, thin = (make_part("box", mesh_of(solid)) for solid in solids)
    assert part.mesh_hash != finer.mesh_hash
    others = (finer, replace(part, mesh=None), other, thin, replace(other, mesh=None))
    assert [part.has_shape_of(each) for each in others] == [True, True, False, False, False]
