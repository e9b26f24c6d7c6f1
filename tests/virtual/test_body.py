"""Stable faces against closed forms and trimesh."""

import numpy as np
import pytest
import trimesh

from dopepp.parts.catalogue import pivconnector
from dopepp.virtual.body import Body, make_hull
from dopepp.virtual.surface import make_surface


def test_a_box_rests_on_six_faces_by_their_solid_angles(surface_of):
    sides = np.array([0.10, 0.06, 0.02])
    normals, shares = make_hull(surface_of(trimesh.creation.box(sides))).rests
    assert len(normals) == 6
    for normal, share in zip(normals, shares, strict=True):
        axis = int(np.abs(normal).argmax())
        np.testing.assert_allclose(np.abs(normal), np.eye(3)[axis], atol=1e-12)
        (a, b), d = np.delete(sides, axis), sides[axis] / 2
        # The solid angle of a rectangle seen from a point above its middle.
        angle = 4 * np.arctan(a * b / (2 * d * np.sqrt(4 * d**2 + a**2 + b**2)))
        assert share == pytest.approx(angle / (4 * np.pi), rel=1e-9)


def test_stable_faces_agree_with_trimesh():
    mesh = pivconnector().mesh
    hull = make_hull(make_surface(mesh))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    np.testing.assert_allclose(hull.centre, solid.center_mass, atol=1e-9)
    poses, chances = solid.compute_stable_poses(threshold=0.01)
    theirs = -poses[:, 2, :3]  # the direction that points down
    normals, shares = hull.rests
    for direction, chance in zip(theirs, chances, strict=True):
        nearest = int((normals @ direction).argmax())
        assert normals[nearest] @ direction > 0.9999
        # trimesh also counts bodies that roll over onto the face.
        assert shares[nearest] == pytest.approx(chance, abs=0.1)
    assert shares.sum() == pytest.approx(1.0)


def test_a_leaning_tower_does_not_stand(surface_of):
    tower = trimesh.creation.box((0.02, 0.02, 0.1))
    tower.vertices[:, 0] += 0.5 * tower.vertices[:, 2]  # its centre is beside its foot
    normals, _ = make_hull(surface_of(tower)).rests
    assert len(normals) == 4
    assert np.abs(normals[:, 2]).max() < 0.99


def test_a_cone_never_stands_on_its_tip(surface_of):
    cone = trimesh.creation.cone(0.03, 0.1, sections=32)
    hull = make_hull(surface_of(cone))
    np.testing.assert_allclose(hull.centre, [0, 0, 0.025], atol=1e-9)
    normals, shares = hull.rests
    assert normals[:, 2].min() == pytest.approx(-1.0)
    assert normals[:, 2].max() < 0.5
    assert len(shares) == 33


def test_a_ball_of_many_faces_rests_on_any(surface_of):
    normals, shares = make_hull(surface_of(trimesh.creation.icosphere(3, 0.05))).rests
    assert len(normals) > 600
    assert np.linalg.norm(shares @ normals) < 0.02


def test_a_flat_sheet_lies_on_either_side(sheet):
    normals, _ = make_hull(make_surface(sheet(0.1))).rests
    np.testing.assert_allclose(np.abs(normals), np.tile([0, 0, 1.0], (len(normals), 1)), atol=1e-3)
    assert {round(z) for z in normals[:, 2]} == {-1, 1}


def test_a_stretched_hull_equals_the_hull_of_the_stretched_body():
    mesh = pivconnector().mesh
    body, scale = Body(make_surface(mesh)), np.array([0.5, 1.2, 3.0])
    stretched = body.stretched(scale)
    fresh = make_hull(stretched.surface)
    np.testing.assert_allclose(stretched.hull.centre, fresh.centre, atol=1e-12)
    assert sorted(stretched.hull.rests[1]) == pytest.approx(sorted(fresh.rests[1]))
    down = np.array([0.3, -0.2, 0.9])
    assert (stretched.hull.vertices @ down).min() == (stretched.surface.vertices @ down).min()
