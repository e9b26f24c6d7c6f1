"""The rasteriser against closed forms and an independent ray caster."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from dopepp.geometry.camera import make_transform, project, transform
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix
from dopepp.parts.catalogue import pivconnector
from dopepp.parts.part import Mesh, Part
from dopepp.virtual import Scene, SceneObject, make_surface, render

MakeScene = Callable[..., Scene]


def cast_rays(scene: Scene) -> np.ndarray:
    """Depth at every pixel centre by Möller–Trumbore over all triangles; inf for no hit."""
    width, height = scene.size
    v, u = np.mgrid[:height, :width].reshape(2, -1)
    rays = np.stack([u, v, np.ones_like(u)], axis=1) @ np.linalg.inv(scene.K).T
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
    return depth.reshape(height, width)


def test_empty_scene_is_its_background(scene_of: MakeScene) -> None:
    rendered = render(scene_of())
    assert (rendered.image == 90).all()
    assert (rendered.depth == 0).all()
    assert (rendered.instances == -1).all()
    assert rendered.visible_fractions.shape == (0,)


def test_plane_has_its_closed_form_depth(scene_of: MakeScene) -> None:
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)
    plane = make_surface(Mesh(corners, np.array([(0, 1, 2), (0, 2, 3)], np.int32)))
    rotation = rotation_vector_to_matrix(np.array([0.5, -0.3, 0.2]))
    offset = np.array([0.02, 0.01, 0.5])
    scene = scene_of(SceneObject(plane, make_transform(rotation, offset)))
    rendered = render(scene)
    v, u = np.mgrid[: scene.size[1], : scene.size[0]]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(scene.K).T
    expected = rotation[:, 2] @ offset / (rays @ rotation[:, 2])
    assert (rendered.instances == 0).all()
    np.testing.assert_allclose(rendered.depth, expected, rtol=1e-6)


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_box_agrees_with_ray_casting(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = trimesh.creation.box((0.10, 0.06, 0.02))
    surface = make_surface(Mesh(np.asarray(box.vertices), np.asarray(box.faces)))
    pose = make_transform(random_rotation(rng), np.array([*rng.uniform(-0.05, 0.05, 2), 0.15]))
    K = np.array([[90.0, 0, 47.3], [0, 91.0, 35.6], [0, 0, 1]])
    scene = Scene(K, np.zeros((72, 96, 3), np.uint8), (SceneObject(surface, pose),))
    rendered, expected = render(scene), cast_rays(scene)
    hit = np.isfinite(expected)
    assert ((rendered.instances == 0) == hit).mean() > 0.999
    both = hit & (rendered.depth > 0)
    np.testing.assert_allclose(rendered.depth[both], expected[both], rtol=1e-5)


def test_part_agrees_with_ray_casting(scene_of: MakeScene) -> None:
    part = pivconnector()
    assert part.mesh is not None
    pose = make_transform(
        rotation_vector_to_matrix(np.array([2.4, 0.5, -0.4])), np.array([0.01, 0.0, 0.12])
    )
    scene = scene_of(SceneObject(make_surface(part.mesh), pose), size=(64, 48), focal=60.0)
    rendered, expected = render(scene), cast_rays(scene)
    hit = np.isfinite(expected)
    assert hit.mean() > 0.1
    assert ((rendered.instances == 0) == hit).mean() >= 0.99
    both = hit & (rendered.depth > 0)
    assert (np.abs(rendered.depth - expected)[both] < 1e-5).mean() >= 0.99


def test_camera_inside_a_box_sees_its_walls(scene_of: MakeScene) -> None:
    # Every wall crosses the camera plane; flipped faces are looked at from behind.
    box = trimesh.creation.box((0.4, 0.3, 1.0))
    surface = make_surface(Mesh(np.asarray(box.vertices), np.asarray(box.faces)[:, ::-1]))
    assert not surface.closed
    scene = scene_of(SceneObject(surface, np.eye(4)))
    rendered, expected = render(scene), cast_rays(scene)
    np.testing.assert_allclose(rendered.depth, expected, rtol=1e-5)


def test_inconsistent_winding_renders_the_same_silhouette_and_shading(
    scene_of: MakeScene, box_part: Part
) -> None:
    assert box_part.mesh is not None
    faces = box_part.mesh.faces.copy()
    faces[::2] = faces[::2, ::-1]
    pose = make_transform(rotation_vector_to_matrix(np.array([0.6, 0.5, 0])), np.array([0, 0, 0.2]))
    whole = make_surface(box_part.mesh)
    mixed = make_surface(Mesh(box_part.mesh.vertices, faces))
    assert whole.closed
    assert not mixed.closed
    first, second = (render(scene_of(SceneObject(s, pose))) for s in (whole, mixed))
    np.testing.assert_array_equal(first.instances, second.instances)
    difference = np.abs(first.image.astype(int) - second.image)
    assert np.percentile(difference, 99) <= 2


def test_nearer_object_wins_whatever_the_order(scene_of: MakeScene, box_part: Part) -> None:
    assert box_part.mesh is not None
    surface = make_surface(box_part.mesh)
    near = SceneObject(surface, make_transform(np.eye(3), np.array([0, 0, 0.2])))
    far = SceneObject(surface, make_transform(np.eye(3), np.array([0.02, 0, 0.3])))
    first, second = render(scene_of(near, far)), render(scene_of(far, near))
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(first.image, second.image)
    both = first.instances >= 0
    np.testing.assert_array_equal(first.instances[both], 1 - second.instances[both])
    assert first.instances[60, 80] == 0


def test_vertices_bound_the_mask(scene_of: MakeScene, box_part: Part) -> None:
    assert box_part.mesh is not None
    pose = make_transform(
        rotation_vector_to_matrix(np.array([0.9, -0.4, 0.3])), np.array([0, 0, 0.25])
    )
    scene = scene_of(SceneObject(make_surface(box_part.mesh), pose, part=box_part))
    rows, columns = np.nonzero(render(scene).instances == 0)
    keypoints = scene.keypoints(0)[:8]
    np.testing.assert_allclose(
        keypoints, project(transform(pose, box_part.cuboid[:8]), scene.K), atol=1e-9
    )
    # A pixel belongs to the mask when its centre is inside: the outermost one is < 1 px inside.
    low, high = keypoints.min(axis=0), keypoints.max(axis=0)
    assert 0 <= columns.min() - low[0] < 1.5
    assert 0 <= rows.min() - low[1] < 1.5
    assert 0 <= high[0] - columns.max() < 1.5
    assert 0 <= high[1] - rows.max() < 1.5


def test_edges_are_anti_aliased_by_coverage(scene_of: MakeScene, box_part: Part) -> None:
    # A white sheet whose left border lies at u = 80.1: pixel 80 keeps its two right samples.
    scene = scene_of(lights=())
    border = 80.1
    x = (border - scene.K[0, 2]) / scene.K[0, 0]
    corners = np.array([(x, -2, 1), (4, -2, 1), (4, 2, 1), (x, 2, 1)], float)
    sheet = make_surface(Mesh(corners, np.array([(0, 2, 1), (0, 3, 2)], np.int32)))
    rendered = render(scene_of(SceneObject(sheet, np.eye(4)), lights=()))
    inside = float(rendered.image[60, 100, 0])
    assert rendered.image[60, 79, 0] == 90
    assert rendered.image[60, 80, 0] == pytest.approx((90 + inside) / 2, abs=1)
    assert rendered.instances[60, 80] == -1
    assert rendered.instances[60, 81] == 0
