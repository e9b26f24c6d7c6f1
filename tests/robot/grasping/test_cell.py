"""The cell: convex pieces of a part, poses of solids, layouts and images."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import invert_transform, make_transform, project_keypoints, transform
from dopepp.parts import convex
from dopepp.parts.catalogue import BUILTIN, load_part
from dopepp.parts.convex import convex_pieces
from dopepp.parts.part import make_part
from dopepp.robot.grasping.cell import TRAY, Cell
from dopepp.robot.grasping.rehearsal import SIZE, TRUE_K, downward_view
from dopepp.robot.grasping.workbench import HEAP, LAYOUTS, SPREAD, Layout, RasterView
from dopepp.virtual.body import make_body


@pytest.mark.parametrize("name", sorted(BUILTIN))
def test_convex_pieces_fill_a_part_and_stay_within_it(name):
    part = load_part(name)
    pieces = convex_pieces(part)
    hulls = [trimesh.convex.convex_hull(piece) for piece in pieces]
    solid = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces)
    assert sum(hull.volume for hull in hulls) == pytest.approx(solid.volume, rel=0.25)
    ends = np.concatenate(pieces)
    np.testing.assert_allclose([ends.min(axis=0), ends.max(axis=0)], solid.bounds, atol=0.002)


def test_a_part_without_a_mesh_has_no_pieces(part):
    with pytest.raises(UserError, match="without a mesh"):
        convex_pieces(replace(part, mesh=None))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"text"])
def test_damaged_pieces_are_named(part, tmp_path, monkeypatch, content):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(convex, "_decompose", lambda mesh: (mesh.vertices,))
    of_user = replace(part, mesh_hash="0" * 64)
    convex_pieces(of_user)
    (path,) = (tmp_path / "dopepp" / "solids").iterdir()
    path.write_bytes(content)
    with pytest.raises(UserError, match=rf"{path.name}: .* fix: delete this file"):
        convex_pieces(of_user)


def test_a_solid_has_the_pose_at_which_it_was_placed(part):
    cell = Cell([make_body(part, is_target=True)] * 2)
    state = cell.data()
    rotation = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    T = make_transform(rotation, np.array([0.1, 0.2, 0.3]))
    cell.put(state, 1, T)
    mujoco.mj_forward(cell.model, state)
    np.testing.assert_allclose(cell.pose(state, 1), T, atol=1e-9)
    assert set(cell.groups.tolist()) == {-1, 0, 1, 2}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_lie_on_the_bench_and_depend_on_the_seed_alone(part, name):
    layout = Layout(part, name, yaw_deg=180.0, rest="any")
    for seed in range(5):
        lying, again = (layout.draw(np.random.default_rng(seed)) for _ in range(2))
        parts = [item for item in lying if item.body.part is not None]
        assert len(parts) == (1 if name != "heap" else len(lying))
        assert name != "heap" or HEAP[0] <= len(parts) <= HEAP[1]
        for item, other in zip(lying, again, strict=True):
            T = item.T_base_obj
            np.testing.assert_array_equal(T, other.T_base_obj)
            heights = item.body.hull.vertices @ T[2, :3] + T[2, 3]
            assert heights.min() > (-0.001 if name == "heap" else 0)  # a heap is at rest
            assert np.linalg.norm(T[:2, 3] - TRAY[:2]) < 0.2


def test_parts_of_a_heap_hardly_move_and_do_not_overlap(part):
    layout = Layout(part, "heap", yaw_deg=180.0, rest="front")
    for seed in range(3):
        heap = layout.draw(np.random.default_rng(seed))
        cell = Cell([item.body for item in heap])
        state = cell.data()
        for index, item in enumerate(heap):
            cell.put(state, index, item.T_base_obj)
        mujoco.mj_step(cell.model, state, nstep=200)
        assert state.contact.dist.min() > -0.001
        for index, item in enumerate(heap):
            shift = cell.pose(state, index)[:3, 3] - item.T_base_obj[:3, 3]
            assert np.linalg.norm(shift) < 0.005


def test_a_part_that_never_rests_makes_no_heap(part, monkeypatch):
    monkeypatch.setattr("dopepp.robot.grasping.workbench.settle", lambda *_: None)
    with pytest.raises(UserError, match="heap"):
        Layout(part, "heap", 180.0, "front").draw(np.random.default_rng(0))


@pytest.mark.parametrize("shift", [0.0, 0.08])
def test_distractors_keep_clear_of_the_part(part, shift):
    """Also if the part's origin is far from its centre."""
    moved = replace(part.mesh, vertices=part.mesh.vertices + shift)
    part = make_part("part", moved)
    layout = Layout(part, "distractors", yaw_deg=0.0, rest="front")
    for seed in range(10):
        first, *others = layout.draw(np.random.default_rng(seed))
        middle = (first.T_base_obj @ [*part.cuboid[-1], 1.0])[:2]
        assert np.linalg.norm(middle - TRAY[:2]) <= SPREAD + 1e-9
        for item in others:
            distance = np.linalg.norm(item.T_base_obj[:2, 3] - middle)
            assert distance > part.diameter / 2


def test_the_front_of_a_part_points_up_and_its_yaw_is_limited(part):
    layout = Layout(part, "single", yaw_deg=20.0, rest="front")
    for seed in range(20):
        T = layout.draw_pose(np.random.default_rng(seed))
        np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-9)
        assert abs(np.degrees(np.arctan2(T[1, 0], T[0, 0]))) <= 20


@pytest.fixture(params=[False, True], ids=["plain", "shadows"])
def take(scene, request):
    """Return the image of parts at poses, from the scene's or another camera."""
    view, bodies = RasterView(request.param), [item.body for item in scene.placed]

    def take(poses, T_base_cam=scene.T_base_cam):
        rng = np.random.default_rng(1)
        photograph = view.arrange(bodies, poses, scene.T_base_cam, rng)
        return photograph(T_base_cam, rng).astype(int)

    return take


def test_an_image_shows_the_part_and_depends_on_the_seed_alone(take, scene):
    image = take(scene.poses)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    np.testing.assert_array_equal(take(scene.poses), image)
    aside = [pose @ make_transform(np.eye(3), [0.0, 0.02, 0.0]) for pose in scene.poses]
    assert 0.005 < (take(aside) != image).any(axis=2).mean() < 0.9


def test_a_second_camera_shows_the_part_at_its_projection(take, trials, scene):
    beside = transform(scene.poses[0], trials.part.cuboid[-1]) + np.array([0.03, 0.02, 0.0])
    T_base_cam = downward_view(beside, 0.2, np.radians([20.0, -15.0]), 0.3)
    away = [make_transform(np.eye(3), [5.0, 5.0, 0.0])]
    changed = take(scene.poses, T_base_cam) - take(away, T_base_cam)
    rows, columns = np.nonzero(np.abs(changed).max(axis=2) > 40)
    T_cam_base = invert_transform(T_base_cam)
    expected = project_keypoints(trials.part.cuboid, T_cam_base @ scene.poses[0], TRUE_K)[-1]
    np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=25)
