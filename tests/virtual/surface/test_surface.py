"""Prepared surfaces: creases, closedness, and meshes that cannot be rendered."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dopepp.core.errors import UserError
from dopepp.parts.part import Mesh
from dopepp.virtual import make_surface
from tests.parts.makers import mesh_of

FACE = np.array([(0, 1, 2)], np.int32)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_cad_edges_stay_sharp_and_cylinders_are_smooth(surface_of):
    surface = surface_of(trimesh.creation.box((0.1, 0.1, 0.1)))
    a, b, c = surface.vertices[surface.faces].swapaxes(0, 1)
    flat = unit(np.cross(b - a, c - a))
    np.testing.assert_allclose(surface.normals, flat[:, None].repeat(3, axis=1), atol=1e-6)
    surface = surface_of(trimesh.creation.cylinder(0.05, 0.1, sections=24))
    side = np.abs(surface.normals[..., 2]) < 0.5
    radial = unit(surface.vertices[surface.faces][side] * (1, 1, 0))
    np.testing.assert_allclose(surface.normals[side], radial, atol=0.02)
    np.testing.assert_allclose(np.abs(surface.normals[~side][:, 2]), 1, atol=1e-6)


def test_split_vertices_are_merged_into_a_closed_smooth_surface():
    # STL gives every triangle vertices of its own.
    ball = trimesh.creation.icosphere(2, 0.05)
    soup = np.asarray(ball.triangles).reshape(-1, 3)
    surface = make_surface(Mesh(soup, np.arange(len(soup), dtype=np.int32).reshape(-1, 3)))
    assert surface.closed
    np.testing.assert_allclose(surface.normals, unit(surface.vertices[surface.faces]), atol=0.03)


def test_open_and_inside_out_meshes_are_not_closed(surface_of):
    ball = trimesh.creation.icosphere(1, 0.05)
    assert surface_of(ball).closed
    ball.invert()
    assert not surface_of(ball).closed
    ball.invert()
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    assert not surface_of(ball).closed


def test_stretching_keeps_normals_upright(surface_of):
    scale = np.array([0.1, 0.2, 0.05])
    stretched = surface_of(trimesh.creation.icosphere(3, 1.0)).scaled(scale)
    # The gradient of the ellipsoid's equation.
    outward = unit(stretched.vertices[stretched.faces] / scale**2)
    np.testing.assert_allclose(stretched.normals, outward, atol=0.05)


BAD_UV = np.array([(0, 0), (np.nan, 0), (0, 1)], np.float32)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (Mesh(np.eye(3), np.zeros((0, 3), np.int32)), "at least one face and finite vertices"),
        (Mesh(np.full((3, 3), np.nan), FACE), "at least one face and finite vertices"),
        *((Mesh(np.eye(3), np.array([(0, 1, i)])), "vertices 0 to 2") for i in (-1, 3, 2**31 - 1)),
        (Mesh(np.eye(3), FACE, BAD_UV, np.zeros((2, 2, 3), np.uint8)), "texture coordinate"),
    ],
)
def test_meshes_that_cannot_be_rendered_are_refused(mesh, message):
    with pytest.raises(UserError, match=message):
        make_surface(mesh)


def test_faces_without_area_change_nothing(sheet):
    mesh = sheet(0.2)
    faces = np.vstack([mesh.faces, [[0, 0, 1], [1, 1, 1]]]).astype(np.int32)
    with np.errstate(all="raise"):
        surface = make_surface(replace(mesh, faces=faces))
    assert np.isfinite(surface.normals).all()
    np.testing.assert_array_equal(surface.normals[:2], make_surface(mesh).normals)


def test_a_files_normals_are_used_where_they_fit_the_surface():
    # The vertex normals of a box are averaged over three sides, so they fit none.
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    mesh = mesh_of(box)
    given = replace(mesh, normals=np.asarray(box.vertex_normals))
    np.testing.assert_array_equal(make_surface(given).normals, make_surface(mesh).normals)
    ball = trimesh.creation.icosphere(3, 0.05)
    normals = ball.vertices * 1000.0  # of any length; one is not finite, one is zero
    normals[0], normals[1] = np.nan, 0
    surface = make_surface(Mesh(ball.vertices, ball.faces.astype(np.int32), normals=normals))
    exact = ball.vertices[ball.faces] / 0.05
    known = ball.faces > 1
    np.testing.assert_allclose(surface.normals[known], exact[known], atol=1e-6)
    np.testing.assert_allclose(surface.normals[~known], exact[~known], atol=0.03)
