import subprocess
import sys

import numpy as np
import pytest
from manifold3d import Error, Manifold, Mesh64
from scipy.spatial.transform import Rotation

from dopepp.parts import pivconnector, servoholder
from tests.parts.makers import solid_of

SIZES = {servoholder: (0.077, 0.077, 0.007), pivconnector: (0.105, 0.052, 0.007)}
PARTS = pytest.mark.parametrize("build", SIZES, ids=lambda build: build.__name__)


def to_solid(part, centre):
    """Millimetres about ``centre`` (metres)."""
    vertices = np.ascontiguousarray(1000 * (part.mesh.vertices - centre))
    solid = Manifold(Mesh64(vertices, part.mesh.faces.astype(np.uint64)))
    assert solid.status() == Error.NoError
    return solid


def share_moved(solid, rotation):
    """Volume of the symmetric difference with the rotated solid, over the solid's own."""
    rotated = solid.transform(np.column_stack([rotation, np.zeros(3)]))
    return float(2 * (1 - (solid ^ rotated).volume() / solid.volume()))


@PARTS
def test_has_the_papers_size_about_the_origin(build):
    part, half = build(), np.array(SIZES[build]) / 2
    assert part.name == build.__name__
    ends = part.mesh.vertices.max(axis=0), part.mesh.vertices.min(axis=0)
    np.testing.assert_allclose(ends, [half, -half], rtol=0, atol=1e-15)
    expected = [half * [1, -1, 1], [0, 0, 0]]
    np.testing.assert_allclose(part.cuboid[[0, 8]], expected, rtol=0, atol=1e-15)
    assert np.linalg.norm(half) * 1.8 < part.diameter <= np.linalg.norm(2 * half)


@PARTS
def test_is_one_printable_solid(build):
    mesh = solid_of(build().mesh)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.euler_number <= 2 - 2 * 5  # at least five through holes
    assert 0.3 < mesh.volume / mesh.bounding_box.volume < 0.7
    assert mesh.area_faces.min() > 1e-11  # no slivers under 10 µm²
    assert 1000 < len(mesh.faces) < 6000


@PARTS
@pytest.mark.parametrize("about", ["bounding box", "centre of mass"])
def test_no_rotation_maps_it_onto_itself(build, about):
    # A symmetry fixes the centre of mass and the axes of the inertia tensor where its moments
    # differ, which leaves rotations about z and flips about axes in the plane.
    part = build()
    assert part is build()  # made once
    centre = part.cuboid[8] if about == "bounding box" else solid_of(part.mesh).center_mass
    solid = to_solid(part, centre)
    group = Rotation.create_group("O").as_matrix()
    shares = [share_moved(solid, R) for R in group if np.trace(R) < 2.9]
    assert len(shares) == 23
    assert min(shares) > 0.8
    turns = Rotation.from_rotvec([[0, 0, angle] for angle in np.radians(np.arange(10, 360, 25))])
    flips = turns * Rotation.from_rotvec([np.pi, 0, 0])
    anything = Rotation.random(10, rng=np.random.default_rng(0))
    tried = Rotation.concatenate([turns, flips, anything])
    far = tried[tried.magnitude() > np.radians(9)] if about == "centre of mass" else anything
    assert min(share_moved(solid, R) for R in far.as_matrix()) > 0.1


def test_has_one_hash_in_every_process():
    code = (
        "from dopepp.parts import *; print(servoholder().mesh_hash, pivconnector().mesh_hash);"
        "import sys; print([m for m in ('torch', 'lightning', 'trimesh') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    hashes, heavy = run.stdout.splitlines()
    assert hashes == f"{servoholder().mesh_hash} {pivconnector().mesh_hash}"
    assert heavy == "[]"
