"""Baked ambient occlusion against brute-force ray casting and closed forms."""

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold

from dopepp.parts.part import Mesh
from dopepp.virtual import make_surface
from dopepp.virtual.surface.occlusion import look_up_sky, spread_directions


def made(solid):
    mesh = solid.to_mesh()
    vertices = np.asarray(mesh.vert_properties, float)[:, :3]
    return make_surface(Mesh(vertices, np.asarray(mesh.tri_verts, np.int32)))


def looked_up(surface, face, share):
    out, sky = np.empty(len(face), np.float32), surface.sky
    weights = np.ascontiguousarray(share.T, np.float32)
    look_up_sky(face.astype(np.int32), weights, sky.steps, sky.firsts, sky.values, out)
    return out


def ray_cast(surface, origins, normals):
    """Cosine-weighted open share by Möller–Trumbore over all triangles."""
    directions = spread_directions(800)
    corners = surface.vertices[surface.faces]
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    shares = []
    for origin, normal in zip(origins, normals, strict=True):
        cosine = directions @ normal
        rays = directions[cosine > 0]
        across = np.cross(rays[:, None], ac[None])
        determinant = np.einsum("rfk,fk->rf", across, ab)
        towards = origin - a
        with np.errstate(divide="ignore", invalid="ignore"):
            first = np.einsum("rfk,fk->rf", across, towards) / determinant
            turned = np.cross(towards, ab)
            second = rays @ turned.T / determinant
            distance = np.einsum("fk,fk->f", ac, turned) / determinant
        hit = (first >= 0) & (second >= 0) & (first + second <= 1) & (distance > 1e-9)
        weight = cosine[cosine > 0]
        shares.append((weight * ~hit.any(axis=1)).sum() / weight.sum())
    return np.array(shares)


@pytest.fixture(scope="module")
def bracket():
    """A plate of two huge triangles a side, with a rib on it and a deep hole through it."""
    plate = Manifold.cube((0.10, 0.06, 0.006), center=True)
    rib = Manifold.cube((0.004, 0.06, 0.03), center=True).translate((0.01, 0, 0.015))
    hole = Manifold.cylinder(0.05, 0.008, circular_segments=24, center=True)
    return made(plate + rib - hole.translate((-0.03, 0, 0)))


def test_a_bracket_agrees_with_ray_casting(bracket):
    rng = np.random.default_rng(0)
    assert bracket.closed
    corners = bracket.vertices[bracket.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(doubled, axis=1)
    face = rng.choice(len(area), 100, p=area / area.sum())
    share = rng.dirichlet((1.5, 1.5, 1.5), 100)
    points = (share[:, :, None] * corners[face]).sum(axis=1)
    normals = doubled[face] / area[face][:, None]
    expected = ray_cast(bracket, points + 1e-7 * normals, normals)
    assert expected.min() < 0.6
    error = np.abs(looked_up(bracket, face, share) - expected)
    assert error.mean() < 0.02
    assert np.percentile(error, 95) < 0.07


def test_beside_a_long_wall_half_the_sky_is_hidden(bracket):
    # A point at distance d from a long wall of height h sees (1 + d/√(d² + h²))/2 of the sky.
    corners = bracket.vertices[bracket.faces]
    up = (np.abs(corners[:, :, 2] - 0.003) < 1e-6).all(axis=1)
    for d in (0.003, 0.01, 0.025):
        place = np.array([0.012 + d, 0.0, 0.003])
        for face in np.nonzero(up)[0]:
            a, b, c = corners[face][:, :2]
            share = np.linalg.solve(np.stack([b - a, c - a], axis=1), place[:2] - a)
            if (share >= 0).all() and share.sum() <= 1:
                weights = np.array([[1 - share.sum(), *share]])
                expected = (1 + d / np.hypot(d, 0.027)) / 2
                share_open = looked_up(bracket, np.array([face]), weights)[0]
                assert share_open == pytest.approx(expected, abs=0.06)
                break
        else:
            pytest.fail("no face under the point")


def test_convex_and_flat_surfaces_have_an_open_sky(sheet):
    for solid in (Manifold.cube((1, 0.7, 0.5)), Manifold.sphere(0.5, 24), Manifold.sphere(0.5, 80)):
        surface = made(solid)
        assert surface.sky.values[0].min() > 0.9
        assert surface.sky.values[0].mean() > 0.98
    assert (make_surface(sheet(1.0)).sky.values == 1).all()


def test_an_open_box_is_dark_inside_on_both_windings():
    box = trimesh.creation.box((1, 1, 1))
    faces = np.asarray(box.faces)[np.asarray(box.face_normals)[:, 2] < 0.5]
    for winding in (1, -1):
        surface = make_surface(Mesh(np.asarray(box.vertices), faces[:, ::winding]))
        assert not surface.closed
        bottom = np.nonzero((box.vertices[faces][:, :, 2] < 0).all(axis=1))[0]
        share = np.full((len(bottom), 3), 1 / 3)
        front, back = looked_up(surface, bottom, share), looked_up(surface, ~bottom, share)
        outside, inside = (front, back) if winding == 1 else (back, front)
        assert outside.min() > 0.95
        # From the middle of a cube's floor the open top fills a form factor of about 0.24; these
        # are the centroids of its two triangles.
        assert (inside > 0.1).all()
        assert (inside < 0.35).all()


def test_the_grid_is_interpolated_without_jumps(bracket):
    face = int(bracket.sky.steps.argmax())
    assert bracket.sky.steps[face] > 8
    line = np.linspace(0, 1, 2001)[:, None]
    for a, b in (((1, 0, 0), (0, 1, 0)), ((0, 0.3, 0.7), (0.9, 0.1, 0)), ((0, 1, 0), (0, 0, 1))):
        share = (1 - line) * np.array(a) + line * np.array(b)
        values = looked_up(bracket, np.full(len(line), face), share)
        assert np.abs(np.diff(values)).max() < 0.03
        assert values.min() >= -1e-5
        assert values.max() <= 1 + 1e-5
