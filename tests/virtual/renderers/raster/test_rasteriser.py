"""The rasteriser against closed forms and an independent ray caster."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trimesh.exchange.stl import export_stl

from dopepp.geometry.camera import make_transform, project, transform
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix
from dopepp.parts import load_part
from dopepp.parts.catalogue import pivconnector
from dopepp.parts.part import Mesh
from dopepp.virtual import make_surface, render
from dopepp.virtual.presets.placement import FACING
from dopepp.virtual.renderers.raster import visibility as shadow_module
from dopepp.virtual.renderers.raster.visibility import shadow_map
from dopepp.virtual.scene import Light, Material, Scene, SceneObject
from dopepp.virtual.triangles import CENTRE_SAMPLE, rasterise
from tests.virtual.conftest import even_light, pixel_rays

LARGE = {"size": (640, 480), "focal": 600.0}


def at(surface, x, y, z):
    return SceneObject(surface, make_transform(np.eye(3), np.array([x, y, z])))


def cast_rays(scene):
    """Depth at every pixel centre by Möller–Trumbore over all triangles; inf for no hit."""
    rays = pixel_rays(scene).reshape(-1, 3)
    depth = np.full(len(rays), np.inf)
    for item in scene.objects:
        corners = transform(item.T_cam_obj, item.surface.vertices)[item.surface.faces]
        for a, b, c in corners:
            normal = np.cross(rays, c - a)
            determinant = normal @ (b - a)
            with np.errstate(divide="ignore", invalid="ignore"):
                first = normal @ -a / determinant
                across = np.cross(-a, b - a)
                second = rays @ across / determinant
                distance = (c - a) @ across / determinant
            hit = (first >= 0) & (second >= 0) & (first + second <= 1) & (distance > 0.01)
            depth[hit] = np.minimum(depth[hit], distance[hit])
    return depth.reshape(scene.size[::-1])


def test_empty_scene_is_its_background(scene_of):
    rendered = render(scene_of())
    assert (rendered.image == 90).all()
    assert (rendered.depth == 0).all()
    assert (rendered.instances == -1).all()
    assert rendered.visible_fractions.shape == (0,)


def test_plane_has_its_closed_form_depth(scene_of, sheet):
    plane = make_surface(sheet(2.0))
    rotation = rotation_vector_to_matrix(np.array([0.5, -0.3, 0.2]))
    offset = np.array([0.02, 0.01, 0.5])
    scene = scene_of(SceneObject(plane, make_transform(rotation, offset)))
    rendered = render(scene)
    expected = rotation[:, 2] @ offset / (pixel_rays(scene) @ rotation[:, 2])
    assert (rendered.instances == 0).all()
    np.testing.assert_allclose(rendered.depth, expected, rtol=1e-6)


@pytest.mark.parametrize("rise", [-3e-14, 0.0, 3e-14])
def test_an_edge_along_a_row_may_have_rounding_errors(rise):
    hom = np.array([[-1e4, 100.5, 1.0], [1e4, 100.5 + rise, 1.0], [0.0, 2e4, 1.0]])
    drawn, ids = np.zeros((480, 640, 1), np.float32), np.empty((480, 640, 1), np.int32)
    faces = np.array([[0, 1, 2]], np.int32)
    rasterise(hom, faces, False, 0.01, (0, 0), CENTRE_SAMPLE, drawn, ids, 0)
    assert (drawn[101:] == 1).all()
    assert (drawn[:101] == 0).all()


@settings(max_examples=15)
@example(1, pivconnector())
@given(st.integers(0, 10_000), st.none())
def test_box_and_part_agree_with_ray_casting(box_surface, seed, part):
    rng = np.random.default_rng(seed)
    pose = make_transform(random_rotation(rng), np.array([*rng.uniform(-0.05, 0.05, 2), 0.15]))
    K = np.array([[90.0, 0, 47.3], [0, 91.0, 35.6], [0, 0, 1]])
    surface = make_surface(part.mesh) if part else box_surface
    scene = Scene(K, np.zeros((72, 96, 3), np.uint8), (SceneObject(surface, pose),))
    rendered, expected = render(scene), cast_rays(scene)
    hit = np.isfinite(expected)
    assert hit.any()
    assert ((rendered.instances == 0) == hit).mean() >= (0.99 if part else 0.999)
    both = hit & (rendered.depth > 0)
    is_same = np.isclose(rendered.depth[both], expected[both], rtol=1e-5)
    assert is_same.mean() >= (0.99 if part else 1.0)


def test_camera_inside_a_box_sees_its_walls(scene_of, surface_of):
    # Every wall crosses the camera plane; flipped faces are looked at from behind.
    box = trimesh.creation.box((0.4, 0.3, 1.0))
    box.invert()
    surface = surface_of(box)
    assert not surface.closed
    scene = scene_of(SceneObject(surface, np.eye(4)))
    rendered, expected = render(scene), cast_rays(scene)
    np.testing.assert_allclose(rendered.depth, expected, rtol=1e-5)


def test_inconsistent_winding_renders_the_same_silhouette_and_shading(
    scene_of, box_part, box_surface
):
    faces = box_part.mesh.faces.copy()
    faces[::2] = faces[::2, ::-1]
    pose = make_transform(rotation_vector_to_matrix(np.array([0.6, 0.5, 0])), np.array([0, 0, 0.2]))
    mixed = make_surface(Mesh(box_part.mesh.vertices, faces))
    assert box_surface.closed
    assert not mixed.closed
    first, second = (render(scene_of(SceneObject(s, pose))) for s in (box_surface, mixed))
    np.testing.assert_array_equal(first.instances, second.instances)
    difference = np.abs(first.image.astype(int) - second.image)
    assert np.percentile(difference, 99) <= 2


def test_the_nearer_object_is_visible_in_any_order(scene_of, box_surface):
    near, far = at(box_surface, 0, 0, 0.2), at(box_surface, 0.02, 0, 0.3)
    first, second = render(scene_of(near, far)), render(scene_of(far, near))
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(first.image, second.image)
    both = first.instances >= 0
    np.testing.assert_array_equal(first.instances[both], 1 - second.instances[both])
    assert first.instances[60, 80] == 0


def test_vertices_bound_the_mask(scene_of, box_part, box_surface):
    turn = rotation_vector_to_matrix(np.array([0.9, -0.4, 0.3]))
    pose = make_transform(turn, np.array([0, 0, 0.25]))
    scene = scene_of(SceneObject(box_surface, pose, part=box_part))
    rows, columns = np.nonzero(render(scene).instances == 0)
    keypoints = scene.keypoints(0)[:8]
    expected = project(transform(pose, box_part.cuboid[:8]), scene.K)
    np.testing.assert_allclose(keypoints, expected, atol=1e-9)
    # A pixel belongs to the mask when its centre is inside: the outermost one is < 1 px inside.
    low, high = keypoints.min(axis=0), keypoints.max(axis=0)
    inside = np.array([columns.min(), rows.min()]) - low, high - (columns.max(), rows.max())
    assert 0 <= np.min(inside) <= np.max(inside) < 1.5


def test_edges_are_anti_aliased_by_coverage(scene_of, sheet):
    # A white sheet whose left border lies at u = 80.1: pixel 80 keeps its two right samples.
    K = scene_of().K
    place = np.array([(80.1 - K[0, 2]) / K[0, 0] + 2, 0, 1])
    item = SceneObject(make_surface(sheet(4.0)), make_transform(FACING, place))
    rendered = render(scene_of(item, lights=()))
    inside = float(rendered.image[60, 100, 0])
    assert rendered.image[60, 79, 0] == 90
    assert rendered.image[60, 80, 0] == pytest.approx((90 + inside) / 2, abs=1)
    assert (rendered.instances[60, 80], rendered.instances[60, 81]) == (-1, 0)


def middle_depth(path, scene_of, turn):
    mesh = load_part(path, "mm").mesh
    pose = make_transform(turn, np.array([0.0, 0.0, 0.4]))
    return float(render(scene_of(SceneObject(make_surface(mesh), pose))).depth[60, 80])


def test_an_open_mesh_shows_both_sides(tmp_path, scene_of, caplog):
    box = trimesh.creation.box((100, 100, 60))
    box.update_faces(box.face_normals[:, 2] > -0.5)  # no bottom
    (tmp_path / "open.stl").write_bytes(export_stl(box))
    with caplog.at_level(logging.INFO):
        into = middle_depth(tmp_path / "open.stl", scene_of, np.eye(3))
    assert "4 open edges" in caplog.text
    assert into == pytest.approx(0.43, abs=1e-4)  # the lid, from its inside
    onto = middle_depth(tmp_path / "open.stl", scene_of, FACING)
    assert onto == pytest.approx(0.37, abs=1e-4)


@pytest.mark.parametrize("inside_out", [False, True])
def test_intersecting_bodies_show_their_outside(tmp_path, scene_of, inside_out):
    slab, pin = trimesh.creation.box((100, 100, 20)), trimesh.creation.box((30, 30, 80))
    if inside_out:
        pin.invert()
    both = trimesh.util.concatenate([slab, pin])
    (tmp_path / "both.stl").write_bytes(export_stl(both))
    assert middle_depth(tmp_path / "both.stl", scene_of, np.eye(3)) == pytest.approx(0.36, abs=1e-4)


@pytest.fixture(scope="module")
def plate(surface_of):
    return surface_of(trimesh.creation.box((0.10, 0.06, 1e-4)))


@pytest.mark.parametrize(
    ("places", "fractions"),
    [
        ([(0, 0, 0.3)], [1]),
        ([(0, -0.04, 0.3), (0, 0.04, 0.3)], [1, 1]),
        # Seen from the camera, the near box's left edge passes through the far box's centre.
        ([(0.05, 0, 0.2), (0, 0, 0.3)], [1, 0.5]),
        ([(0, 0, 0.2), (0, 0, 0.4), (5, 0, 0.4), (0, 0, -1)], [1, 0, 0, 0]),
        ([(0, 0, -1)], [0]),
    ],
    ids=["whole", "side by side", "half", "hidden or outside", "behind"],
)
def test_the_visible_share_of_every_object(scene_of, plate, places, fractions):
    result = render(scene_of(*(at(plate, *place) for place in places), **LARGE)).visible_fractions
    np.testing.assert_allclose(result, fractions, atol=0.005 if 0.5 in fractions else 0)


@pytest.mark.parametrize("share", [0.5, 0.25])
def test_truncated_by_the_image_border(scene_of, plate, share):
    # The image ends at u = −0.5: put the box so that the asked share of its width is beyond it.
    K = scene_of(**LARGE).K
    edge = (-0.5 - K[0, 2]) / K[0, 0] * 0.3
    scene = scene_of(at(plate, edge + (share - 0.5) * 0.10, 0, 0.3), **LARGE)
    assert render(scene).visible_fractions[0] == pytest.approx(share, abs=0.005)


def test_a_huge_silhouette_is_counted_at_a_reduced_scale(scene_of, plate):
    # At 2 cm the box is 3,000 × 1,800 px, of which the image shows 640 × 480.
    fraction = render(scene_of(at(plate, 0, 0, 0.02), **LARGE)).visible_fractions[0]
    near_face = 0.02 - 0.5e-4
    area = (600 * 0.10 / near_face) * (1.02 * 600 * 0.06 / near_face)
    assert fraction == pytest.approx(640 * 480 / area, rel=0.01)


def without_casters(*arguments):
    """A shadow map that nothing was drawn into."""
    drawn = shadow_map(*arguments)
    return replace(drawn, inverse_depth=np.zeros_like(drawn.inverse_depth))


@pytest.mark.parametrize("inside_out", [False, True])
@pytest.mark.parametrize(
    "body", [trimesh.creation.icosphere(1, 0.05), trimesh.creation.cylinder(0.03, 0.1, sections=16)]
)
def test_a_smooth_body_of_few_triangles_does_not_shadow_itself(
    scene_of, surface_of, monkeypatch, body, inside_out
):
    body = body.copy()
    if inside_out:  # not closed, so its triangles are drawn from both sides
        body.invert()
    surface = surface_of(body)
    rng = np.random.default_rng(3)
    for _ in range(4):
        pose = make_transform(random_rotation(rng), np.array([0.0, 0.0, 0.18]))
        side = rng.normal(size=2)
        x, y = side / np.linalg.norm(side)
        item = SceneObject(surface, pose, Material((0.9, 0.9, 0.9), 1.0, specular=0.0))
        light = {"lights": (Light((x, y, 0.3)),), "ambient": even_light(0.0)}
        scene = scene_of(item, **light, size=(320, 240), focal=300.0)
        rendered = render(scene)
        with_shadow = rendered.image.astype(int)
        with monkeypatch.context() as patch:
            patch.setattr(shadow_module, "shadow_map", without_casters)
            without = render(scene).image.astype(int)
        # Dots of shadow would be dozens of levels dark.
        assert np.abs(with_shadow - without).max() <= 3
        assert without[rendered.instances == 0].max() > 60
