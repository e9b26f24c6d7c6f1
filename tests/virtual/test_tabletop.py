"""Objects on tables and in heaps: contact, no piercing, views, and a background that fits."""

from dataclasses import replace

import manifold3d
import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import transform
from dopepp.parts.mesh.read import read_mesh, ycb_part
from dopepp.parts.part import make_part
from dopepp.virtual import Factory
from dopepp.virtual.body import Distractors
from dopepp.virtual.presets import PRESETS, preset_of
from dopepp.virtual.tabletop import HeightMap
from tests.virtual.conftest import draw_scenes

NUM_SCENES = 25
CONTACT = 1e-4


class Constant:
    """Backgrounds of one grey level after another."""

    def draw(self, rng, width, height):
        return np.full((height, width, 3), rng.integers(1, 255), np.uint8)


class Ramp:
    """An image whose red is its column and whose green is its row, over 256 px."""

    def draw(self, rng, width, height):
        ramp = np.zeros((height, width, 3), np.uint8)
        ramp[..., 0], ramp[..., 1] = np.arange(width), np.arange(height)[:, None]
        return ramp


def small(name, **changes):
    return preset_of(name, changes).resized(160, 120)


def heights(scene, item):
    """Heights of an object's vertices above the plane, metres."""
    points = transform(item.T_cam_obj, item.surface.vertices)
    return np.asarray(points @ np.array(scene.plane.normal) - scene.plane.offset)


@pytest.fixture(scope="module")
def tables(parts):
    return draw_scenes(parts, small("table"), 1, NUM_SCENES, Constant())


@pytest.fixture(scope="module")
def heaps(parts):
    return draw_scenes(parts, small("bin"), 1, NUM_SCENES, Constant())


def test_objects_on_a_table_touch_the_plane(tables):
    for scene in tables:
        for item in scene.objects:
            assert -1e-9 <= heights(scene, item).min() <= CONTACT
    assert {len(scene.targets) for scene in tables} == {1, 2, 3}
    assert {len(scene.objects) - len(scene.targets) for scene in tables} >= {1, 4, 7}


def test_objects_rest_on_a_face_or_lean_on_an_edge(parts):
    lying, leaning = (
        draw_scenes(parts, small("table", table={"tilted_share": share}), 1, 8, Constant())
        for share in (0.0, 1.0)
    )
    for scene, other in zip(lying, leaning, strict=True):
        for item in scene.objects:
            assert (heights(scene, item) < 1e-5).sum() >= 3
        low = [heights(other, other.objects[i]) for i in other.targets]
        # A leaning plate touches along an edge or at a corner, not with its face.
        assert all((values < 1e-5).sum() < len(values) / 10 for values in low)
        assert all(-1e-9 <= values.min() <= CONTACT for values in low)


def test_heaps_stand_on_the_plane(heaps):
    for scene in heaps:
        assert -1e-9 <= min(heights(scene, item).min() for item in scene.objects) <= CONTACT
    assert any(max(heights(s, i).min() for i in s.objects) > 0.005 for s in heaps)
    counts = [len(scene.targets) for scene in heaps]
    assert min(counts) >= 2
    assert max(counts) >= 8


def solid(item):
    vertices = transform(item.T_cam_obj, item.surface.vertices)
    merged, index = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    mesh = manifold3d.Mesh64(merged, index.reshape(-1)[item.surface.faces].astype(np.uint64))
    return manifold3d.Manifold(mesh)


@pytest.mark.parametrize(("name", "most"), [("table", 1e-4), ("bin", 0.02)])
def test_objects_do_not_pierce_each_other(name, most, tables, heaps):
    shares = []
    for scene in (tables if name == "table" else heaps)[:12]:
        solids = [solid(item) for item in scene.objects]
        assert all(body.volume() > 0 for body in solids)
        for number, body in enumerate(solids):
            for other in solids[:number]:
                shared = (body ^ other).volume()
                shares.append(shared / min(body.volume(), other.volume()))
    assert len(shares) > 20
    assert max(shares) < most


def test_camera_poses_are_within_their_ranges(tables):
    distances, elevations = [], []
    for scene in tables:
        normal = np.array(scene.plane.normal)
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        assert scene.plane.offset < 0
        distances.append(scene.plane.offset / normal[2])
        elevations.append(np.degrees(np.arcsin(-normal[2])))
        for light in scene.lights:
            assert normal @ np.array(light.position) > scene.plane.offset
    assert 0.25 <= min(distances) < 0.32 < 0.52 < max(distances) <= 0.60
    assert 30 - 1e-9 <= min(elevations) < 45 < 70 < max(elevations) <= 85 + 1e-9


def test_the_background_image_lies_on_the_plane(parts):
    wide = {"picture_width": (8.0, 8.0), "elevation_deg": (45.0, 85.0)}
    preset = replace(preset_of("table", {"table": wide}), width=256, height=256)
    for scene in draw_scenes(parts, preset, 4, 4, Ramp()):
        normal = np.array(scene.plane.normal)
        v, u = np.mgrid[10:250:7, 10:250:7].reshape(2, -1)
        rays = np.stack([u, v, np.ones(u.shape)], axis=1) @ np.linalg.inv(scene.K).T
        points = rays * (scene.plane.offset / (rays @ normal))[:, None]
        # Any two axes in the plane: the map from it to the image must be one similarity.
        first = np.cross(normal, [0.3, 0.5, 0.7])
        first /= np.linalg.norm(first)
        plane_xy = np.stack([points @ first, points @ np.cross(normal, first), np.ones(u.shape)], 1)
        levels = scene.background[v, u, :2].astype(float)
        fit, *_ = np.linalg.lstsq(plane_xy, levels, rcond=None)
        assert np.abs(plane_xy @ fit - levels).max() < 1.2  # grey levels, which are whole
        similarity = fit[:2].T @ fit[:2]
        np.testing.assert_allclose(similarity, similarity[0, 0] * np.eye(2), rtol=0.05,
                                   atol=0.05 * similarity[0, 0])  # fmt: skip


def test_another_image_is_shown_beyond_the_horizon(parts):
    preset = small("table", table={"elevation_deg": (12.0, 12.0), "roll_deg": 0.0})
    background = Factory(parts, preset, 4, Constant()).scene(0, 0).background
    assert len(np.unique(background)) == 2
    # At 12° the horizon lies f·tan 12° above the middle; the table ends a little below it.
    focal, horizon = preset.K[1, 1], preset.K[1, 2] - preset.K[1, 1] * np.tan(np.radians(12))
    edge = int(np.flatnonzero(background[:, 80, 0] != background[0, 80, 0])[0])
    assert horizon < edge < horizon + focal * 0.05


def test_an_image_without_targets_has_its_distractors(parts):
    for name in ("table", "bin", "paper", "quickstart", "ycb"):
        changes = {"targets_per_image": (0, 0), "distractors": Distractors((3, 3))}
        preset = replace(PRESETS[name].resized(96, 72), **changes)
        factory = Factory(parts, preset, 0)
        scenes = [factory.scene(0, index) for index in range(2)]
        assert all(scene.targets == () for scene in scenes)
        assert sum(len(scene.objects) for scene in scenes) >= 4
        factory.preset = replace(preset, distractors=Distractors((0, 0)))
        assert factory.render(0, 1).scene.objects == ()


@pytest.mark.parametrize("name", ["table", "bin"])
def test_parts_from_files_lie_on_the_table(name, shared_data, ycb_root):
    path = min((shared_data / "parts" / "so_arm100").glob("*.stl"))
    printed = make_part("printed", read_mesh(path, "mm"))
    theirs = [printed, ycb_part(ycb_root, "006_mustard_bottle")]
    for scene in draw_scenes(theirs, small(name), 0, 4, Constant()):
        assert scene.targets
        lowest = [heights(scene, item).min() for item in scene.objects]
        assert min(lowest) >= -1e-9
        assert name == "bin" or max(lowest) <= CONTACT


def test_a_dropped_box_lands_on_earlier_objects(surface_of):
    surface = surface_of(trimesh.creation.box((0.04, 0.02, 0.03)))
    table = HeightMap(0.001, 0.1)
    footprint = table.footprint(surface, np.eye(3), -0.015)
    assert table.height(footprint, (0, 0)) == 0.0
    table.put(footprint, (0, 0), 0.0)
    assert table.height(footprint, (10, 5)) == pytest.approx(0.03, abs=1e-6)
    assert not table.is_free(footprint, (10, 5))
    assert not table.is_free(footprint, (40, 0))  # side by side, within a cell
    assert table.is_free(footprint, (43, 0))
    assert table.height(footprint, (43, 0)) == 0.0
    assert table.height(footprint, (95, 0)) is None  # off the map
    turned = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    lying = table.footprint(surface, turned, -0.01)
    table.put(footprint, (10, 5), 0.03)
    assert table.height(lying, (0, 0)) == pytest.approx(0.06, abs=1e-6)


def test_a_block_rests_on_the_highest_point_of_a_slope(surface_of):
    profile, ends = ((-0.05, 0.0), (0.05, 0.0), (0.05, 0.05)), (-0.05, 0.05)
    wedge = trimesh.convex.convex_hull(np.array([[x, y, z] for x, z in profile for y in ends]))
    table = HeightMap(0.001, 0.1)
    slope = table.footprint(surface_of(wedge), np.eye(3), 0.0)
    block = table.footprint(surface_of(trimesh.creation.box([0.01] * 3)), np.eye(3), -0.005)
    table.put(slope, (0, 0), 0.0)
    # Height z = (x + 5 cm)/2; the block's right edge is 5 mm beside its middle.
    for x in (-20, 0, 30):
        expected = (0.001 * x + 0.005 + 0.05) / 2
        assert table.height(block, (x, 0)) == pytest.approx(expected, abs=8e-4)
