"""Path-traced images: the rasteriser's labels, and plausible light."""

import importlib
import pickle
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from dopepp.core.errors import UserError
from dopepp.geometry.camera import make_transform
from dopepp.parts.catalogue import BUILTIN
from dopepp.parts.mesh.read import read_mesh
from dopepp.virtual import PRESETS, Factory, make_surface, render
from dopepp.virtual.renderers import find_renderer, renderer_identity
from dopepp.virtual.renderers.photoreal import mitsuba
from dopepp.virtual.renderers.photoreal.mitsuba_scene import _texture_level
from dopepp.virtual.scene import Grooves, Light, Material, Panel, Plane, SceneObject
from tests.parts.makers import mesh_of
from tests.virtual.conftest import even_light

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def photoreal():
    pytest.importorskip("mitsuba", reason="the extra photoreal is not installed")
    pytest.importorskip("pyoidn", reason="the extra photoreal is not installed")
    return find_renderer("photoreal")


def test_the_identity_names_the_library_and_its_variant(photoreal):
    module = mitsuba()
    words = renderer_identity("photoreal").split()
    assert words[:3] == ["mitsuba", module.__version__, module.variant()]
    assert renderer_identity("raster") == ""  # the hash of dopepp's code is enough


def test_the_identity_does_not_start_mitsuba(photoreal):
    """The threads of a started Mitsuba do not survive the fork of a data loader's workers."""
    code = (
        "import sys; from dopepp.virtual.renderers import renderer_identity; "
        "renderer_identity('photoreal'); assert 'mitsuba' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def lying(part, height, **options):
    """Place a part's frame above the plane that :func:`on_table` adds, half a metre away."""
    T = make_transform(np.eye(3), [0.0, 0.0, 0.5 - height])
    return SceneObject(make_surface(part.mesh), T, part=part, **options)


def on_table(scene):
    """Look straight down on a plane at half a metre."""
    return replace(scene, plane=Plane((0.0, 0.0, -1.0), -0.5))


def likeness(first, other):
    """Return the correlation of each channel of pixels, (n, 3)."""
    return [np.corrcoef(*pair)[0, 1] for pair in zip(first.T, other.T, strict=True)]


def assert_same_labels(result, expected):
    assert (np.abs(result.depth - expected.depth) < 1e-3).mean() >= 0.99
    assert (result.instances == expected.instances).mean() >= 0.99
    np.testing.assert_array_equal(result.visible_fractions, expected.visible_fractions)


@pytest.mark.parametrize(("preset", "seed"), [("paper", 1), ("paper", 2), ("table", 3), ("bin", 5)])
def test_labels_agree_with_the_rasteriser(photoreal, preset, seed):
    parts = [make() for make in BUILTIN.values()]
    scene = Factory(parts, PRESETS[preset].resized(160, 120), seed).scene(0, seed)
    expected, result = render(scene), photoreal(scene)
    assert_same_labels(result, expected)
    # The labels are not the rasteriser's by construction: each renderer casts its own.
    assert (result.image.dtype, result.depth.dtype) == (np.uint8, np.float32)
    assert result.instances.dtype == np.int16
    # The same lamps and colours, so about the same image.
    assert abs(result.image.astype(float).mean() - expected.image.mean()) < 12


@pytest.mark.parametrize(
    "material",
    [
        Material(),
        Material(metallic=1.0, roughness=0.15, colour=(0.9, 0.7, 0.4)),
        Material(noise=0.5, noise_pitch=0.01),
        Material(metallic=0.5, grooves=Grooves(irregularity=1.0)),
        Material(roughness=1.0, specular=0.0, colour=(0.0, 0.0, 0.0)),
    ],
)
def test_every_material_renders(photoreal, material, box_part, scene_of):
    scene = scene_of(lying(box_part, 0.1, material=material))
    result = photoreal(scene)
    covered = result.instances == 0
    assert covered.sum() > 500
    assert not np.array_equal(result.image[covered], scene.background[covered])
    away = cv2.dilate(covered.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    np.testing.assert_array_equal(result.image[away], scene.background[away])
    assert_same_labels(result, render(scene))


def test_a_textured_model_shows_its_texture(photoreal, ycb_root, scene_of):
    mesh = read_mesh(ycb_root / "models" / "003_cracker_box" / "textured.obj", "m")
    T = make_transform([[0, 0, 1], [1, 0, 0], [0, 1, 0]], [0, 0, 0.5])
    scene = scene_of(SceneObject(make_surface(mesh), T), lights=(Light((0.3, -0.3, 0.0)),))
    expected, result = render(scene), photoreal(scene)
    assert_same_labels(result, expected)
    covered = expected.instances == 0
    assert min(likeness(expected.image[covered], result.image[covered])) > 0.9


def test_a_texture_has_the_same_level_for_any_origin(ycb_root):
    mesh, levels = read_mesh(ycb_root / "models" / "003_cracker_box" / "textured.obj", "m"), set()
    for offset in (0.0, 3.0, -3.0):
        moved = make_surface(replace(mesh, vertices=mesh.vertices + np.array([0, 0, offset])))
        item = SceneObject(moved, make_transform(np.eye(3), [0, 0, 0.5 - offset]))
        levels.add(_texture_level(item, PRESETS["ycb"].K))
    assert len(levels) == 1


def test_no_light_at_all_is_black_and_finite(photoreal, box_part, scene_of):
    scene = on_table(scene_of(lying(box_part, 0.01), lights=(), ambient=even_light(0.0)))
    result = photoreal(scene)
    inside = result.instances == 0
    assert (np.percentile(result.image[inside], 90) == 0).all()
    # Without light, objects cast no shadow on the table.
    np.testing.assert_array_equal(result.image[:4], scene.background[:4])


def test_the_table_is_darker_near_the_contact(photoreal, box_part, scene_of):
    scene = on_table(scene_of(lying(box_part, 0.01), lights=()))
    result = photoreal(scene)
    assert result.depth[0, 0] == pytest.approx(0.5, abs=1e-6)
    row = np.flatnonzero((result.instances == 0).any(axis=1))[-1]
    column = scene.size[0] // 2
    below = result.image[row + 2 :, column].astype(float).mean(axis=1)
    assert below[0] < 80  # of a background of 90
    assert below[0] < below[6] < below[20] + 1.0


def test_a_shadow_falls_away_from_its_lamp(photoreal, box_part, scene_of):
    lamp, dim = Light((-0.4, 0.0, 0.2)), even_light(0.02)
    scene = on_table(scene_of(lying(box_part, 0.03), lights=(lamp,), ambient=dim))
    result, expected = photoreal(scene), render(scene)
    columns = np.flatnonzero((result.instances == 0).any(axis=0))
    row = scene.size[1] // 2
    left, right = result.image[row, [columns[0] - 4, columns[-1] + 4]].mean(axis=1)
    assert right < 45 < left
    assert right == pytest.approx(expected.image[row, columns[-1] + 4].mean(), abs=15)


@pytest.mark.parametrize("roughness", [0.2, 0.5])
def test_a_metal_ball_mirrors_panels_where_the_rasteriser_does(photoreal, scene_of, roughness):
    ball = mesh_of(trimesh.creation.icosphere(subdivisions=5, radius=0.08))
    steel = Material((0.8, 0.8, 0.8), roughness=roughness, metallic=1.0)
    item = SceneObject(make_surface(ball), make_transform(np.eye(3), [0.0, 0.0, 0.4]), steel)
    right = Panel((0.8, 0.0, -0.6), (0.0, 1.0, 0.0), 0.06, 0.4, (3.0, 1.0, 1.0))
    above = Panel((0.0, -0.6, -0.8), (1.0, 0.0, 0.0), 0.15, 0.15, (1.0, 1.0, 3.0))
    dim = even_light(0.05, up=(0, -1, 0), panels=(right, above))
    scene = scene_of(item, lights=(), ambient=dim)
    result, expected = photoreal(scene), render(scene)
    inside = cv2.erode((expected.instances == 0).astype(np.uint8), np.ones((5, 5))) > 0
    first, other = (each.image[inside].astype(float) for each in (result, expected))
    red, _, blue = likeness(first, other)
    assert min(red, blue) > 0.95
    assert np.abs(first - other).mean() < 12


def test_a_mirror_reflects_a_red_neighbour(photoreal, box_part, scene_of):
    mirror = Material(metallic=1.0, roughness=0.05, colour=(0.9, 0.9, 0.9))
    red = Material(colour=(0.9, 0.02, 0.02))
    plate = lying(box_part, 0.1, material=mirror)
    # A wall on edge along the plate's far side, leaning over it towards the camera.
    turned = make_transform([[1, 0, 0], [0, 0, 1], [0, -1, 0]], [0.0, -0.042, 0.36])
    wall = replace(plate, T_cam_obj=turned, material=red)
    scene = scene_of(plate, wall)
    both, alone = photoreal(scene), photoreal(replace(scene, objects=(plate,)))
    plate_px = (both.instances == 0) & (alone.instances == 0)

    def redness(rendered):
        values = rendered.image[plate_px].astype(float)
        return float((values[:, 0] - values[:, 1]).max())

    assert redness(both) > redness(alone) + 30


def test_pixels_that_are_not_square(photoreal, box_part, scene_of):
    scene = scene_of(lying(box_part, 0.1))
    K = scene.K.copy()
    K[0, 0] *= 1.3
    K[0, 1] = 5.0
    scene = replace(scene, K=K)
    expected, result = render(scene), photoreal(scene)
    assert_same_labels(result, expected)
    covered = expected.instances == 0
    # The image stands where the labels do.
    changed = (result.image != scene.background).any(axis=2)
    assert (changed & covered).sum() > 0.97 * covered.sum()
    near = cv2.dilate(covered.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert not (changed & ~near).any()


def test_a_scene_gives_the_same_bytes(photoreal, box_part, scene_of):
    scene = on_table(scene_of(lying(box_part, 0.02)))
    first, second = photoreal(scene), photoreal(pickle.loads(pickle.dumps(scene)))
    for field in ("image", "depth", "instances"):
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field))


def test_an_empty_scene_is_its_background(photoreal, scene_of):
    scene = scene_of()
    for result in (photoreal(scene), photoreal(on_table(scene))):
        np.testing.assert_array_equal(result.image, scene.background)
        assert (result.instances == -1).all()


@pytest.mark.parametrize("package", ["mitsuba", "pyoidn"])
def test_the_missing_extra_is_named(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "dopepp.virtual.renderers.photoreal.renderer", raising=False)
    pattern = rf"without the package {package}.*pip install 'dopepp\[photoreal\]'"
    with pytest.raises(UserError, match=pattern):
        importlib.import_module("dopepp.virtual.renderers.photoreal.renderer")
    with pytest.raises(UserError, match=pattern):
        find_renderer("photoreal")


def test_vertex_colours_agree_with_the_rasteriser(photoreal, scene_of):
    ball = trimesh.creation.icosphere(3, 0.06)
    shades = np.clip(128 + 2000 * ball.vertices, 0, 255).astype(np.uint8)
    surface = make_surface(replace(mesh_of(ball), colours=shades))
    matt = Material((0.8, 0.8, 0.8), 1.0, 0.0)
    item = SceneObject(surface, make_transform(np.eye(3), [0, 0, 0.4]), matt)
    scene = scene_of(item, lights=(), ambient=even_light(0.6))
    expected, result = render(scene), photoreal(scene)
    covered = (expected.instances == 0) & (result.instances == 0)
    apart = expected.image[covered].astype(int) - result.image[covered]
    assert np.abs(np.median(apart, axis=0)).max() < 8
    assert min(likeness(expected.image[covered], result.image[covered])) > 0.95
