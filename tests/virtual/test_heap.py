"""Heaps: objects rest on each other without overlaps, the same in every process, in any view."""

from dataclasses import replace

import numpy as np
import pytest

import dopepp.core.errors
from dopepp.core.errors import UserError
from dopepp.geometry.camera import invert_transform, make_transform, transform
from dopepp.virtual import Factory, heap
from dopepp.virtual.presets import preset_of
from dopepp.virtual.presets.table import Pile
from dopepp.virtual.renderers import find_renderer
from dopepp.virtual.renderers.raster import visible_fractions
from tests.virtual.conftest import draw_scenes

BOX = np.array([0.10, 0.06, 0.02])  # sides of ``box_part``
DIAMETER = float(np.linalg.norm(BOX))


def small(**changes):
    fewer = {"targets_per_image": [5, 9], "distractors": {"number": [0, 0]}}
    return preset_of("heap", {**fewer, **changes}).resized(160, 120)


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory):
    pytest.importorskip("mujoco", reason="needs the extra robot")
    pytest.importorskip("coacd", reason="needs the extra robot")
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="module")
def heaps(box_part):
    return draw_scenes([box_part], small(), 1, 6)


def in_table_frame(scene):
    """Poses of the boxes relative to a frame on the plane with z upwards."""
    normal = np.array(scene.plane.normal)
    x = np.cross([0.3, 0.5, 0.7], normal)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(normal, x), normal])
    T = make_transform(R, -scene.plane.offset * np.array([0.0, 0.0, 1.0]))
    return [T @ item.T_cam_obj for item in scene.objects if item.is_target]


def grid(steps=9):
    """Points over a box's surface, box frame."""
    axis = np.linspace(-0.5, 0.5, steps)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    return points[np.isclose(np.abs(points).max(axis=1), 0.5)] * BOX


def depth_inside(pose, other):
    """Largest depth of one box's surface inside another box, metres."""
    points = transform(invert_transform(other) @ pose, grid())
    return float((BOX / 2 - np.abs(points)).min(axis=1).max())


def test_objects_of_a_heap_overlap_by_less_than_a_hundredth_of_the_diameter(heaps):
    for scene in heaps:
        poses = in_table_frame(scene)
        assert 5 <= len(poses) <= 9
        for number, pose in enumerate(poses):
            assert transform(pose, grid())[:, 2].min() > -0.01 * DIAMETER
            for other in poses[:number]:
                assert depth_inside(pose, other) < 0.01 * DIAMETER
                assert depth_inside(other, pose) < 0.01 * DIAMETER


def test_no_object_floats(heaps):
    for scene in heaps:
        poses = in_table_frame(scene)
        for pose in poses:
            on_floor = transform(pose, grid())[:, 2].min() < 0.01 * DIAMETER
            others = [other for other in poses if other is not pose]
            # A box a little lower would enter the box or the wall that carries it.
            lowered = make_transform(pose[:3, :3], pose[:3, 3] - [0.0, 0.0, 0.03 * DIAMETER])
            depths = [(depth_inside(lowered, o), depth_inside(o, lowered)) for o in others]
            carried = np.max(depths) > 0
            leans = len(scene.objects) > len(poses)  # on the bin, which is not a box
            assert on_floor or carried or leans
    highest = [max(pose[2, 3] for pose in in_table_frame(scene)) for scene in heaps]
    assert max(highest) > 0.04  # at least two thicknesses: boxes lie on boxes


def test_objects_lie_inside_a_bin(box_part):
    table = {"pile": {"bin_share": 1.0, "wall_height": [1.0, 1.0], "room": [2.5, 2.5]}}
    scene = Factory([box_part], small(table=table), 2).scene(0, 0)
    (walls,) = (item for item in scene.objects if not item.is_target)
    T_bin_cam = invert_transform(walls.T_cam_obj)
    width, depth, height = np.ptp(walls.surface.vertices, axis=0)
    assert height == pytest.approx(DIAMETER)
    for item in scene.objects:
        if item.is_target:
            x, y, z = transform(T_bin_cam @ item.T_cam_obj, grid()).T
            assert max(np.abs(x).max() - width / 2, np.abs(y).max() - depth / 2) < 0
            assert z.min() > -0.01 * DIAMETER


def test_a_heap_is_the_same_with_and_without_cache(box_part, heaps, cache):
    assert list((cache / "dopepp" / "piles").glob("*.npy"))
    cached = Factory([box_part], small(), 1).scene(0, 0)
    for path in (cache / "dopepp" / "piles").glob("*.npy"):
        path.unlink()
    simulated = Factory([box_part], small(), 1).scene(0, 0)
    for scene in (cached, simulated):
        for item, again in zip(heaps[0].objects, scene.objects, strict=True):
            np.testing.assert_array_equal(item.T_cam_obj, again.T_cam_obj)


def test_a_damaged_cache_is_named(box_part, cache):
    factory = Factory([box_part], small(), 5)
    factory.scene(0, 0)
    files = (cache / "dopepp" / "piles").glob("*.npy")
    newest = max(files, key=lambda path: path.stat().st_mtime_ns)
    for content in (newest.read_bytes()[:200], b"", b"PK\3\4"):
        newest.write_bytes(content)
        with pytest.raises(UserError, match="delete this file"):
            factory.scene(0, 0)
    newest.unlink()


def relative(scene):
    first = invert_transform(scene.objects[0].T_cam_obj)
    return np.stack([first @ item.T_cam_obj for item in scene.objects])


def test_images_share_a_heap_and_differ_in_view(box_part):
    factory = Factory([box_part], small(table={"pile": {"piles": 2}}), 1)
    scenes = [factory.scene(epoch, index) for epoch, index in ((0, 0), (0, 2), (3, 0))]
    for scene in scenes[1:]:
        np.testing.assert_allclose(relative(scene), relative(scenes[0]), atol=1e-9)
        assert np.abs(scene.objects[0].T_cam_obj - scenes[0].objects[0].T_cam_obj).max() > 0.01
    first, other = relative(scenes[0]), relative(factory.scene(0, 1))
    assert len(other) != len(first) or np.abs(other - first).max() > 0.01
    low, high = ({Pile(piles=7).number(i + shift) for i in range(10_000)} for shift in (0, 10**9))
    assert low.isdisjoint(high)


def test_several_kinds_and_distractors_are_dropped(sized_box):
    kinds = [sized_box("large", 1.0), sized_box("small", 0.5)]
    table = {"pile": {"mixed_share": 1.0, "bin_share": 0.0}}
    changes = {"table": table, "distractors": {"number": [2, 2]}}
    scene = Factory(kinds, small(**changes), 3).scene(0, 0)
    assert {item.label for item in scene.objects} == {"large", "small", "distractor"}
    assert sum(item.label == "distractor" for item in scene.objects) == 2
    changes["table"] = {"pile": {"mixed_share": 0.0}}
    scene = Factory(kinds, small(**changes), 3).scene(0, 0)
    assert len({item.label for item in scene.objects if item.is_target}) == 1


def test_a_window_shows_a_heap_and_labels_only_parts_in_view(box_part):
    for scene in draw_scenes([box_part], replace(small(), window=(64, 64)), 1, 6):
        assert scene.targets
        inside = np.array([item.is_target for item in scene.objects])
        assert not visible_fractions(scene)[~inside].any() or (~inside).sum() <= 1  # the bin


def test_a_window_omits_only_objects_that_are_far_beside_it(box_part, monkeypatch):
    view = replace(small(targets_per_image=[25, 25]).resized(640, 480), window=(64, 64))
    some = [scene.objects for scene in draw_scenes([box_part], view, 3, 4)]
    monkeypatch.setattr(heap, "_BESIDE", np.inf)
    scenes = draw_scenes([box_part], view, 3, 4)
    assert sum(map(len, some)) < sum(len(scene.objects) for scene in scenes)
    for kept, scene in zip(some, scenes, strict=True):
        poses = {item.T_cam_obj.tobytes() for item in kept}
        shown = find_renderer("raster")(scene).instances
        for number, item in enumerate(scene.objects):
            if item.T_cam_obj.tobytes() not in poses:
                assert not item.is_target
                assert not (shown == number).any()


def test_a_heap_that_reaches_the_camera_is_shown_without_its_top(box_part):
    # The camera is 12 cm above the table, the heap of 30 boxes in a narrow bin is higher.
    table = {"pile": {"bin_share": 1.0, "room": [0.5, 0.6]}, "distance": [0.12, 0.12]}
    table["elevation_deg"] = [89.0, 90.0]
    for scene in draw_scenes([box_part], small(targets_per_image=[30, 30], table=table), 3, 3):
        targets = in_table_frame(scene)
        assert 0 < len(targets) < 30
        assert max(pose[2, 3] for pose in targets) < 0.12


def test_a_missing_extra_is_named_in_one_line(box_part, monkeypatch):
    monkeypatch.setattr(dopepp.core.errors, "find_spec", lambda name: None)
    message = r"without the package mujoco.*pip install 'dopepp\[robot\]'"
    with pytest.raises(UserError, match=message):
        Factory([box_part], small(), 0)


def test_a_heap_refuses_visibility_options():
    changes = {"min_visible_fraction": 0.3, "centroid_inside": True, "depths": (0.1, 1.0)}
    for change in ({field: value} for field, value in changes.items()):
        with pytest.raises(UserError, match="physics decides what is visible"):
            preset_of("heap", change)


def test_a_simulation_is_not_lost_if_its_cache_cannot_be_written(tmp_path, monkeypatch, caplog):
    from dopepp.virtual.physics import settle  # needs the extra robot

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "dopepp").write_text("a file in place of the cache folder")
    start = np.eye(4)[None]
    start[0, 2, 3] = 0.05
    corners = np.array(list(np.ndindex(2, 2, 2))) * 0.04 - 0.02
    poses = settle([(corners,)], start, [], 0.07)
    assert abs(poses[0, 2, 3] - 0.02) < 0.001
    assert "cannot be written" in caplog.text
