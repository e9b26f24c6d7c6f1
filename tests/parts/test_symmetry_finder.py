"""Shapes with known symmetry groups, in any pose and with any triangles."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.creation import box, cone, cylinder, icosphere
from trimesh.transformations import translation_matrix

from dopepp.core.errors import UserError
from dopepp.parts.symmetry_finder import cached_symmetries, find_symmetries
from tests.parts.makers import mesh_of


def plate(*holes):
    """A plate of 100 × 60 × 6 with holes (x, y, radius)."""
    cut = [cylinder(r, 20, sections=48).apply_translation((x, y, 0)) for x, y, r in holes]
    return box((100, 60, 6)).difference(cut, engine="manifold")


def bracket():
    """An L with unequal legs, extruded."""
    leg = box((20, 50, 10), transform=translation_matrix((-20, 15, 0)))
    return trimesh.boolean.union([box((60, 20, 10)), leg], engine="manifold")


SHAPES = {
    "box": (box((3, 2, 1)), 3, 0),
    "square prism": (box((2, 2, 5)), 7, 0),
    "cube": (box((1, 1, 1)), 23, 0),
    "cylinder": (cylinder(33, 100, sections=32), 1, 1),
    "cone": (cone(30, 80, sections=64), 0, 1),
    "triangular prism": (cylinder(10, 9, sections=3), 5, 0),
    "hexagonal prism": (cylinder(10, 8, sections=6), 11, 0),
    "sphere": (icosphere(4), 0, 3),
    "bracket": (bracket(), 0, 0),
    "two equal holes": (plate((28, 0, 8), (-28, 0, 8)), 3, 0),
    "two unequal holes": (plate((28, 0, 8), (-28, 0, 6)), 1, 0),
    "one small hole": (plate((30, 10, 4)), 0, 0),
    "one hole on an axis": (plate((30, 0, 4)), 1, 0),
}

SLOW = ("cube", "sphere", "triangular prism", "square prism", "hexagonal prism")
"""Shapes with many axes, which take long, and are tested moved and recut only."""


def as_mesh(shape):
    return mesh_of(shape.copy().apply_scale(1e-3))


def moved(shape, seed):
    """Cut into smaller triangles, turned and shifted."""
    rng = np.random.default_rng(seed)
    copy = shape.subdivide_to_size(shape.scale / 5) if len(shape.faces) < 1000 else shape.copy()
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.normal(size=3) * shape.scale
    return copy.apply_transform(T)


CASES = [
    pytest.param(name, drawn, marks=[pytest.mark.slow] * (name in ("cube", "triangular prism")))
    for name in SHAPES
    for drawn in (True, False)
    if name not in SLOW or not drawn
]


@pytest.mark.parametrize(("name", "as_drawn"), CASES)
def test_the_group_of_a_known_shape_is_found(name, as_drawn):
    shape, num_discrete, num_axes = SHAPES[name]
    mesh = as_mesh(shape if as_drawn else moved(shape, seed=len(name)))
    discrete, continuous = find_symmetries(mesh)
    assert (len(discrete), len(continuous)) == (num_discrete, num_axes)
    group = np.concatenate([np.eye(4)[None], discrete])
    # By trimesh's own distances: each moved corner lies on the surface.
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    corners = mesh.vertices[:: len(mesh.vertices) // 20 + 1]
    for S in group if len(solid.faces) < 1000 else ():
        away = trimesh.proximity.closest_point_naive(solid, corners @ S[:3, :3].T + S[:3, 3])[1]
        assert away.max() < 0.01 * solid.scale
    if not num_axes:
        products = (group[:, None] @ group[None]).reshape(-1, 1, 16)
        assert np.abs(products - group.reshape(1, -1, 16)).max(2).min(1).max() < 1e-9


def test_a_box_has_its_half_turns_exactly_and_about_its_middle():
    shape = box((3, 2, 1)).apply_translation((10, 20, 30))
    discrete, _ = find_symmetries(as_mesh(shape))
    diagonals = {tuple(np.diag(S)) for S in discrete}
    assert diagonals == {(1, -1, -1, 1), (-1, 1, -1, 1), (-1, -1, 1, 1)}
    middle = np.array([0.010, 0.020, 0.030, 1.0])
    assert np.abs(discrete @ middle - middle).max() < 1e-12


def test_a_cylinder_has_its_axis_through_the_point_nearest_the_origin():
    shape = cylinder(33, 100, sections=48).apply_translation((5, -7, 400))
    (flip,), ((axis, offset),) = find_symmetries(as_mesh(shape))
    assert np.allclose(axis, (0, 0, 1), atol=1e-9)
    assert np.allclose(offset, (0.005, -0.007, 0), atol=1e-9)
    assert np.allclose(flip[:3, :3] @ (0, 0, 1), (0, 0, -1), atol=1e-9)


def test_a_larger_tolerance_overlooks_a_smaller_hole():
    mesh = as_mesh(plate((30, 10, 4)))
    assert len(find_symmetries(mesh, 0.01)[0]) == 0
    assert len(find_symmetries(mesh, 0.05)[0]) == 3


def test_a_search_is_stored_by_mesh_and_tolerance(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    meshes = [as_mesh(shape) for shape in (box((3, 2, 1)), cylinder(33, 100), plate((30, 10, 4)))]
    expected = [find_symmetries(mesh) for mesh in meshes]
    searched = [cached_symmetries(mesh) for mesh in meshes]
    with monkeypatch.context() as patch:
        patch.setattr("dopepp.parts.symmetry_finder.find_symmetries", None)
        stored = [cached_symmetries(mesh) for mesh in meshes]
    assert len(cached_symmetries(meshes[2], 0.05)[0]) == 3
    for (wanted, axes), *results in zip(expected, searched, stored, strict=True):
        for discrete, continuous in results:
            np.testing.assert_array_equal(discrete, wanted)
            assert continuous == axes


@pytest.mark.parametrize("tolerance", [0.0, -1.0, 0.5, float("nan")])
def test_a_tolerance_out_of_range_is_refused(tolerance):
    with pytest.raises(UserError, match=r"tolerance of .*0\.0001 – 0\.1 diameters"):
        find_symmetries(as_mesh(box((1, 1, 1))), tolerance)
