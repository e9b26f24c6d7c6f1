from __future__ import annotations

import numpy as np
import pytest
import trimesh

from dopepp.parts.mesh.measure import SurfaceTree

SHAPES = {
    "box": trimesh.creation.box((1.0, 0.6, 0.06)),
    "cylinder": trimesh.creation.cylinder(0.3, 1.0),
    "ball": trimesh.creation.icosphere(3),
}


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_those_to_all_triangles(name: str) -> None:
    mesh = SHAPES[name]
    surface = SurfaceTree(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (500, 3)) * mesh.extents
    _, expected, _ = trimesh.proximity.closest_point_naive(mesh, points)
    found = surface.distances(points)
    assert (found > expected - 1e-12).all()
    assert np.abs(found - expected).max() < 0.004 * mesh.scale
    assert np.quantile(np.abs(found - expected), 0.98) < 1e-12


def test_points_are_spread_by_area_and_lie_on_their_triangles() -> None:
    mesh = SHAPES["box"]
    surface = SurfaceTree(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    points, owners = surface.spread(3000, seed=0)
    own = surface.triangles[owners]
    heights = ((points - own[:, 0]) * surface.normals[owners]).sum(axis=1)
    assert np.abs(heights).max() < 1e-12
    share = np.bincount(owners, minlength=len(surface.areas)) / 3000
    assert np.abs(share - surface.areas / surface.areas.sum()).max() < 1e-3
    closest, normals = surface.nearest(points + 1e-4 * surface.normals[owners])
    assert np.quantile(np.abs(closest - points).max(axis=1), 0.95) < 2e-4
    assert ((normals * surface.normals[owners]).sum(axis=1) > 0.99).mean() > 0.99


def test_triangles_without_area_are_refused() -> None:
    with pytest.raises(ValueError, match="total area of 0"):
        SurfaceTree(np.zeros((3, 3)), np.array([[0, 1, 2]]))
