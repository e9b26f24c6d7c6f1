import logging

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from trimesh.exchange.stl import export_stl

from dopepp.parts import read_mesh, servoholder
from dopepp.parts.mesh import weld
from dopepp.parts.mesh.read import MANY_CAVITIES, find_topology, flip_faces, misoriented_faces


def arrays(*meshes):
    mesh = trimesh.util.concatenate(meshes)
    return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)


def topology_of(vertices, faces):
    return find_topology(weld(vertices, faces)[1])


def repaired(vertices, faces):
    topology = topology_of(vertices, faces)
    return flip_faces(faces, misoriented_faces(vertices, faces, topology))


def cyclic(faces):
    """Triangles by their corners and direction, wherever they start."""
    return {tuple(np.roll(face, -int(face.argmin())).tolist()) for face in faces}


def test_edges_agree_with_trimesh():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = arrays(mesh)
    assert topology_of(vertices, faces).is_closed
    cut = faces[np.random.default_rng(0).random(len(faces)) < 0.9]
    topology = topology_of(vertices, cut)
    edges = trimesh.Trimesh(vertices, cut, process=False).edges_sorted
    unique = trimesh.grouping.group_rows(edges, require_count=1)
    assert (topology.num_open, topology.num_crowded) == (len(unique), 0)
    assert len(unique) > 0
    tip = np.vstack([vertices, [[9.0, 9.0, 9.0]]])
    fin = np.vstack([faces, [[faces[0, 0], faces[0, 1], len(vertices)]]])
    assert (topology_of(tip, fin).num_crowded, topology_of(tip, fin).num_open) == (1, 2)
    soup = mesh.triangles.reshape(-1, 3)  # corners at one position are one
    assert topology_of(soup, np.arange(len(soup)).reshape(-1, 3)).is_closed


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0, 1), whole=st.booleans())
def test_any_closed_solid_ends_up_facing_outwards(seed, share, whole):
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.annulus(0.3, 1.0, 0.5, sections=16)
    vertices, faces = arrays(mesh)
    turned = flip_faces(faces, rng.random(len(faces)) < share)
    result = repaired(vertices, turned if whole else turned[rng.permutation(len(faces))])
    assert cyclic(result) == cyclic(faces)


def test_an_open_surface_follows_its_majority():
    vertices, faces = arrays(trimesh.creation.icosphere(subdivisions=2))
    bowl = faces[vertices[faces].mean(axis=1)[:, 2] < 0.3]
    wrong = np.arange(len(bowl)) % 5 == 0
    assert cyclic(repaired(vertices, flip_faces(bowl, wrong))) == cyclic(bowl)
    inwards = flip_faces(bowl, ~wrong)  # a bowl has no inside
    assert cyclic(repaired(vertices, inwards)) == cyclic(bowl[:, ::-1])


def test_every_body_is_repaired_by_itself_and_a_cavity_stays():
    outer, inner = trimesh.creation.icosphere(2, 1.0), trimesh.creation.icosphere(2, 0.5)
    inner.invert()
    vertices, faces = arrays(outer, inner)
    np.testing.assert_array_equal(repaired(vertices, faces), faces)
    mixed = flip_faces(faces, np.arange(len(faces)) % 7 == 0)
    assert cyclic(repaired(vertices, mixed)) == cyclic(faces)


def test_cavities_beyond_the_limit_count_as_bodies():
    block, pore = trimesh.creation.box((50, 50, 50)), trimesh.creation.icosahedron()
    pore.invert()
    grid = np.stack(np.meshgrid(*[np.arange(11) * 4.0 - 20] * 3), axis=-1).reshape(-1, 3)
    pores = [pore.copy().apply_translation(place) for place in grid]
    vertices, faces = arrays(block, *pores)
    changed = (repaired(vertices, faces) != faces).any(axis=1).sum()
    assert changed == 20 * (len(grid) - MANY_CAVITIES)


def test_one_body_of_several_that_faces_inwards_is_flipped():
    ball = trimesh.creation.icosphere(2, 1.0)
    beside = trimesh.creation.box((0.5, 0.5, 0.5))
    beside.apply_translation((2, 0, 0))
    vertices, faces = arrays(ball, beside)
    wrong = flip_faces(faces, np.arange(len(faces)) >= len(ball.faces))
    assert cyclic(repaired(vertices, wrong)) == cyclic(faces)
    assert cyclic(repaired(vertices, faces)) == cyclic(faces)


def test_a_moebius_strip_is_unchanged():
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rims = []
    for side in (-0.2, 0.2):
        radius, height = 1 + side * np.cos(around / 2), side * np.sin(around / 2)
        rims.append(np.stack([radius * np.cos(around), radius * np.sin(around), height], axis=1))
    vertices, i = np.concatenate(rims), np.arange(24)
    c, d = np.append(i[1:], 24), np.append(i[1:] + 24, 0)  # the ends are joined upside down
    strip = np.concatenate([np.c_[i, i + 24, c], np.c_[i + 24, d, c]])
    assert topology_of(vertices, strip).opposed.any()
    np.testing.assert_array_equal(repaired(vertices, strip), strip)


@pytest.fixture
def read(write, caplog):
    """Return what is read from an STL file of meshes, its path, and the log."""

    def read(*meshes):
        path = write("a.stl", export_stl(trimesh.util.concatenate(meshes)))
        with caplog.at_level(logging.INFO):
            return read_mesh(path, "mm"), path, caplog.records

    return read


@pytest.mark.parametrize("share", [0.1, 1.0])
def test_a_file_that_faces_the_wrong_way_is_repaired(read, share, volume):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=20)
    ball.faces = flip_faces(ball.faces, np.random.default_rng(0).random(len(ball.faces)) < share)
    loaded, path, (record,) = read(ball)
    assert record.levelname == "INFO"
    assert record.message.startswith(f"{path}: flipped")
    assert volume(loaded) > 0


def test_holes_are_counted_in_one_line(read):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=20)
    ball.update_faces(np.arange(len(ball.faces)) >= 1)
    loaded, path, (record,) = read(ball)
    assert record.message.startswith(f"{path} is not watertight")
    assert "3 open edges" in record.message
    assert len(loaded.faces) == 319


def test_intersecting_bodies_are_accepted(read):
    boxes = [trimesh.creation.box((20, 20, 20)), trimesh.creation.box((10, 10, 40))]
    loaded, _, records = read(*boxes)
    assert not records
    np.testing.assert_allclose(np.ptp(loaded.vertices, axis=0), [0.02, 0.02, 0.04])


def test_a_consistent_mesh_is_unchanged():
    mesh = servoholder().mesh
    np.testing.assert_array_equal(repaired(mesh.vertices, mesh.faces), mesh.faces)
