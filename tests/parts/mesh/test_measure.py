import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from dopepp.parts import servoholder
from dopepp.parts.mesh import SurfaceTree, largest_distance, sample_surface, weld


@given(
    num_points=st.integers(2, 80),
    seed=st.integers(0, 2**32 - 1),
    rank=st.integers(1, 3),
    far=st.sampled_from([0.0, 10.0]),
)
def test_largest_distance_agrees_with_all_pairs(num_points, seed, rank, far):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(num_points, rank)) @ rng.normal(size=(rank, 3)) + far
    assert largest_distance(points) == pytest.approx(pdist(points).max(), rel=1e-9)


BALL = np.random.default_rng(1).normal(size=(2000, 3))
BALL /= np.linalg.norm(BALL, axis=1, keepdims=True)


SETS = {
    "one": np.zeros((1, 3)),
    "coincident": np.full((5, 3), 0.3),
    "duplicates": np.repeat(np.eye(3), 4, axis=0),
    "cube": np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T.astype(float),
    "many": np.random.default_rng(0).normal(size=(3000, 3)),
    "all on the hull": BALL,
}


@pytest.mark.parametrize("points", SETS.values(), ids=SETS)
def test_largest_distance_of_special_sets(points):
    expected = pdist(points).max() if len(points) > 1 else 0.0
    assert largest_distance(points) == pytest.approx(expected, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("shape", ["ball", "noisy ball", "egg", "corner", "lens"])
def test_largest_distance_of_rounded_sets_without_all_pairs(shape):
    # More corners than are compared with each other; every point is one.
    rng = np.random.default_rng(2)
    points = rng.normal(size=(7000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    if shape == "noisy ball":
        points *= rng.uniform(0.9999, 1, (7000, 1))
    elif shape == "egg":
        points *= [1, 1, 1.2 + 0.1 * (points[0, 2] > 0)]
        points[:, 2] *= np.where(points[:, 2] > 0, 1.3, 1)
    elif shape == "corner":
        points = np.abs(points)  # an eighth of a ball: its longest lines join its three tips
    elif shape == "lens":
        points = points[np.abs(points[:, 0]) > 0.4] * [0.1, 1, 1]
    exact = pdist(points).max()
    assert exact * (1 - 9e-4) < largest_distance(points) <= exact * (1 + 1e-12)


def test_largest_distance_of_one_point_outside_a_plane():
    x, y = np.meshgrid(np.linspace(0, 1, 100), np.linspace(0, 1, 100))
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    points[1] = [0.5, 0.5, 3]
    assert largest_distance(points) == pytest.approx(np.sqrt(9.5), rel=1e-12)


def test_samples_lie_on_the_surface():
    mesh = servoholder().mesh
    points = sample_surface(mesh.vertices, mesh.faces, num_points=300)
    # In millimetres: trimesh's absolute tolerances find wrong closest points on metre-size slivers.
    reference = trimesh.Trimesh(1000 * mesh.vertices, mesh.faces, process=False)
    distances = trimesh.proximity.closest_point_naive(reference, 1000 * points)[1]
    assert distances.max() < 1e-9


def test_samples_are_uniform_over_the_surface():
    # A box cut into one huge and many small triangles: shares follow area, not faces.
    size = np.array([0.1, 0.2, 0.3])
    box = trimesh.creation.box(size)
    top = box.face_normals[:, 2] > 0.9
    lid = box.submesh([top], append=True).subdivide().subdivide()
    fine = trimesh.util.concatenate([box.submesh([~top], append=True), lid])
    points = sample_surface(np.asarray(fine.vertices), np.asarray(fine.faces), 20_000)
    on_side = np.abs(np.abs(points) - size / 2) < 1e-12
    assert on_side.any(axis=1).all()
    area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    expected = area / area.sum()
    # Four standard deviations of a binomial share.
    assert (np.abs(on_side.mean(axis=0) - expected) < 4 * np.sqrt(0.25 / 20_000)).all()
    # Within one face the two coordinates are uniform: mean 0, variance a²/12.
    face = points[on_side[:, 0]] / size
    np.testing.assert_allclose(face[:, 1:].mean(axis=0), 0, atol=0.02)
    np.testing.assert_allclose(face[:, 1:].var(axis=0), 1 / 12, atol=0.005)


def test_a_face_without_area_gets_no_sample():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]])
    faces = np.array([[3, 3, 3], [0, 1, 2], [0, 3, 3]])
    assert sample_surface(vertices, faces).max() <= 1
    for sampler in (sample_surface, SurfaceTree):
        with pytest.raises(ValueError, match="area"):
            sampler(np.zeros((3, 3)), np.array([[0, 1, 2]]))


def test_weld_merges_equal_positions_and_the_two_zeros():
    soup = trimesh.creation.box((1, 2, 3)).triangles.reshape(-1, 3)
    vertices, faces = weld(soup, np.arange(36).reshape(12, 3))
    assert len(vertices) == 8
    np.testing.assert_array_equal(vertices[faces].reshape(-1, 3), soup)
    assert len(weld(np.array([[0.0, 0, 0], [-0.0, 0, 0]]), np.array([[0, 1, 1]]))[0]) == 1


SHAPES = {
    "box": trimesh.creation.box((1.0, 0.6, 0.06)),
    "cylinder": trimesh.creation.cylinder(0.3, 1.0),
    "ball": trimesh.creation.icosphere(3),
}


@pytest.mark.parametrize("mesh", SHAPES.values(), ids=SHAPES)
def test_distances_agree_with_all_triangles(mesh):
    surface = SurfaceTree(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (500, 3)) * mesh.extents
    _, expected, _ = trimesh.proximity.closest_point_naive(mesh, points)
    result = surface.distances(points)
    assert (result > expected - 1e-12).all()
    assert np.abs(result - expected).max() < 0.004 * mesh.scale
    assert np.quantile(np.abs(result - expected), 0.98) < 1e-12


def test_points_are_spread_by_area_and_lie_on_their_triangles():
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
