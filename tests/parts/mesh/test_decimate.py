import logging
import re

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from dopepp.parts import make_part, part, servoholder
from dopepp.parts.mesh.decimate import decimate


def distance(points, vertices, faces):
    """Distance to a dense sample of a surface, an upper bound of that to the surface."""
    solid = trimesh.Trimesh(vertices, faces, process=False)
    return cKDTree(trimesh.sample.sample_surface(solid, 400_000, seed=0)[0]).query(points)[0]


def test_a_part_keeps_its_shape():
    mesh = servoholder().mesh
    fine = trimesh.Trimesh(
        *trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, 0.0015), process=False
    )
    fine.merge_vertices(digits_vertex=9)
    vertices, faces = np.asarray(fine.vertices), np.asarray(fine.faces)
    assert len(faces) > 100_000
    fewer, kept, uv, moved = decimate(vertices, faces, None, 20_000)
    assert uv is None
    assert 0.8 * 20_000 < len(kept) <= 20_000
    np.testing.assert_array_equal(np.unique(kept), range(len(fewer)))
    assert 0 < moved < 0.003
    # Sides are flat and edges straight, so the surface moves far less than its vertices do.
    away, back = distance(fewer, vertices, faces), distance(vertices[::7], fewer, kept)
    assert np.quantile(away, 0.99) < 4e-4
    assert np.quantile(back, 0.95) < 4e-4
    assert max(away.max(), back.max()) <= moved + 4e-4
    np.testing.assert_allclose(np.ptp(fewer, axis=0), np.ptp(vertices, axis=0), rtol=1e-3)


def test_a_ball_stays_a_ball_that_faces_outwards():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.05)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    fewer, kept, _, moved = decimate(vertices, faces, None, 5000)
    radii = np.linalg.norm(fewer, axis=1)
    assert np.abs(radii / 0.05 - 1).max() < 0.01
    solid = trimesh.Trimesh(fewer, kept, process=False)
    assert solid.volume == pytest.approx(ball.volume, rel=0.01)
    outward = np.einsum("fi,fi->f", solid.face_normals, solid.triangles_center)
    assert (outward > 0).mean() > 0.995
    cells = np.linalg.norm(vertices[cKDTree(vertices).query(fewer)[1]] - fewer, axis=1)
    assert cells.max() <= moved


@given(
    seed=st.integers(0, 2**32 - 1),
    num_faces=st.integers(30, 400),
    size=st.sampled_from([0.02, 0.5, 3.0]),
    flat=st.booleans(),
)
def test_any_triangles_are_decimated(seed, num_faces, size, flat):
    rng = np.random.default_rng(seed)
    corners = rng.random((num_faces, 1, 3)) + size * rng.random((num_faces, 3, 3))
    if flat:
        corners[..., 2] = 0
    vertices, faces = corners.reshape(-1, 3), np.arange(3 * num_faces).reshape(-1, 3)
    try:
        fewer, kept, _, moved = decimate(vertices, faces, None, 20)
    except ValueError:  # too small and apart, which a test of its own looks at
        return
    assert 0 < len(kept) <= 20
    assert kept.max() < len(fewer)
    low, high = vertices.min(axis=0) - 1e-12, vertices.max(axis=0) + 1e-12
    assert ((fewer >= low) & (fewer <= high)).all()
    assert moved <= np.linalg.norm(np.ptp(vertices, axis=0))


def test_texture_coordinates_stay_on_their_side_of_a_seam():
    # A tube unrolled: at the seam one position has u = 0 and u = 1.
    count, rings = 240, 200
    grid = np.meshgrid(np.linspace(0, 1, count + 1), np.linspace(0, 1, rings + 1))
    uv = np.stack(grid, axis=-1).reshape(-1, 2)
    turn = 2 * np.pi * (uv[:, 0] % 1)
    vertices = np.stack([np.cos(turn), np.sin(turn), 3 * uv[:, 1]], axis=1)
    corner = (np.arange(rings)[:, None] * (count + 1) + np.arange(count)).ravel()
    right, up = corner + 1, corner + count + 1
    faces = np.concatenate([np.c_[corner, right, up], np.c_[right, up + 1, up]])
    fewer, kept, coordinates, _ = decimate(vertices, faces, uv, 6000)
    span = np.ptp(coordinates[kept][..., 0], axis=1)
    assert span.max() < 0.1  # no triangle runs across the whole texture
    around = np.arctan2(fewer[:, 1], fewer[:, 0]) / (2 * np.pi) % 1
    off = np.abs(coordinates[:, 0] - around)
    assert np.minimum(off, 1 - off).max() < 0.02
    np.testing.assert_allclose(coordinates[:, 1], fewer[:, 2] / 3, atol=0.02)


def test_the_part_is_measured_before_it_is_decimated(monkeypatch, caplog):
    mesh = servoholder().mesh
    whole = make_part("a", mesh)
    assert whole.mesh is mesh
    monkeypatch.setattr(part, "MAX_FACES", 500)
    monkeypatch.setattr(part, "decimate", lambda v, f, uv: decimate(v, f, uv, 500))
    with caplog.at_level(logging.WARNING):
        fewer = make_part("a", mesh)
    assert (len(caplog.records), caplog.text.count("\n")) == (1, 1)
    message = rf"part 'a': {len(mesh.faces)} triangles decimated to \d+; vertices moved"
    assert re.match(message + r" by up to [\d.]+ mm$", caplog.records[0].message)
    assert len(fewer.mesh.faces) <= 500
    assert (fewer.mesh.faces.dtype, fewer.mesh_hash) == (np.int32, whole.mesh_hash)
    assert fewer.diameter == whole.diameter
    np.testing.assert_array_equal(fewer.cuboid, whole.cuboid)
    np.testing.assert_array_equal(fewer.points, whole.points)


def test_tiny_separate_triangles_are_refused():
    # Far more separate specks than the limit, each inside of a cell of any grid that is tried.
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 1, 3) + 0.45
    specks = grid + 1e-6 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(ValueError, match="216 triangles that cannot be reduced to 4"):
        decimate(specks.reshape(-1, 3), np.arange(648).reshape(-1, 3), None, 4)
