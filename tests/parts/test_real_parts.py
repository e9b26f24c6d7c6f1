import shutil
from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import pdist

from dopepp.core.errors import UserError
from dopepp.parts import load_part, ycb_part
from tests.parts.makers import solid_of

TEXTURED = ("003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle", "009_gelatin_box",
            "010_potted_meat_can")  # fmt: skip
GELATIN = "009_gelatin_box"
loaded = cache(ycb_part)


def test_stl_parts_agree_with_trimesh(shared_data):
    paths = sorted(p for p in (shared_data / "parts").rglob("*") if p.suffix.lower() == ".stl")
    assert len(paths) == 6
    for path in paths:
        part = load_part(path)
        reference = trimesh.load_mesh(path)
        assert 0.05 < part.diameter < 0.1
        hull = np.asarray(reference.convex_hull.vertices) / 1000
        assert part.diameter == pytest.approx(pdist(hull).max())
        solid = solid_of(part.mesh)
        assert solid.is_watertight == reference.is_watertight
        assert solid.volume == pytest.approx(reference.volume / 1e9)
        assert part.points.shape == (2000, 3)


@pytest.mark.parametrize("name", TEXTURED)
def test_a_textured_model_agrees_with_trimesh(ycb_root, name):
    part = loaded(ycb_root, name)
    folder = ycb_root / "models" / name
    reference = trimesh.load_mesh(folder / "textured.obj", process=False)
    assert part.mesh.texture.shape == (1024, 1024, 3)
    image = np.asarray(reference.visual.material.image.convert("RGB"))
    np.testing.assert_array_equal(part.mesh.texture, image)
    np.testing.assert_allclose(np.ptp(part.mesh.vertices, axis=0), reference.extents, atol=1e-9)
    ours = np.concatenate([part.mesh.vertices, part.mesh.uv], axis=1)[part.mesh.faces]
    area = reference.area_faces > 1e-12 * np.square(reference.extents).sum()
    theirs = np.concatenate([reference.vertices, reference.visual.uv], axis=1)[reference.faces]
    np.testing.assert_allclose(_sorted(ours), _sorted(theirs[area]), atol=1e-9)


def _sorted(triangles):
    rows = np.round(triangles.reshape(len(triangles), -1), 9)
    return rows[np.lexsort(rows.T[::-1])]


def test_every_ycb_object_has_all_its_points_and_a_sane_size(ycb_root):
    names = sorted(path.name for path in (ycb_root / "models").iterdir() if path.is_dir())
    assert len(names) == 21
    for name in names:
        part = loaded(ycb_root, name)
        points = np.loadtxt(ycb_root / "models" / name / "points.xyz")
        np.testing.assert_array_equal(part.points, points)
        assert (part.mesh is not None) == (name in TEXTURED)
        assert 0.08 < part.diameter < 0.3
        # The points were drawn from the model, so both have about the same box.
        assert (points.min(axis=0) > part.cuboid.min(axis=0) - 0.004).all()
        assert (points.max(axis=0) < part.cuboid.max(axis=0) + 0.004).all()
        # The model frame's origin lies near the middle, but is not the box centre.
        assert np.abs(part.cuboid[8]).max() < 0.15 * part.diameter


@pytest.fixture
def copied_root(ycb_root, tmp_path):
    folder = tmp_path / "models" / GELATIN
    shutil.copytree(ycb_root / "models" / GELATIN, folder, copy_function=shutil.copyfile)
    return tmp_path


def test_an_unknown_object_lists_the_known_ones(copied_root):
    for name in ("009_gelatin", "../models/009_gelatin_box", "", "*"):
        with pytest.raises(UserError, match=r"unknown object .*; allowed: 009_gelatin_box; "):
            ycb_part(copied_root, name)


def test_a_folder_without_ycb_models_is_refused(tmp_path):
    for root in (tmp_path, tmp_path / "gone"):
        with pytest.raises(UserError, match=r"no models/NAME/points\.xyz; .*data\.root"):
            ycb_part(root, GELATIN)


@pytest.mark.parametrize(
    "text", ["", "1 2\n3 4\n", "1 2 3\n4 5\n", "1 2 x\n", "1 2 nan\n"], ids=repr
)
def test_damaged_points_are_refused(copied_root, text):
    (copied_root / "models" / GELATIN / "points.xyz").write_text(text)
    with pytest.raises(UserError, match=r"points\.xyz.*; allowed: three finite numbers per line"):
        ycb_part(copied_root, GELATIN)


def test_a_broken_mesh_is_no_missing_mesh(copied_root):
    mesh_path = copied_root / "models" / GELATIN / "textured.obj"
    mesh_path.write_bytes(mesh_path.read_bytes()[:500_000])
    with pytest.raises(UserError, match=r"textured\.obj"):
        ycb_part(copied_root, GELATIN)
    mesh_path.unlink()
    assert ycb_part(copied_root, GELATIN).mesh is None
