"""Degenerate meshes and poses, on which compiled code must neither crash nor hang."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import random_rotation
from dopepp.parts.part import Mesh
from dopepp.virtual import make_surface, render
from dopepp.virtual.renderers.raster import silhouette, visible_fractions
from dopepp.virtual.scene import Ambient, Grooves, Light, Material, Plane, Scene, SceneObject

pytestmark = pytest.mark.usefixtures("quick_sky")

FLOOR = Plane((0.0, -1.0, 0.0), -0.3)


def check(scene):
    for plane in (None, FLOOR):
        rendered = render(replace(scene, plane=plane))
        assert ((rendered.depth >= 0) & (rendered.depth < np.inf)).all()
        assert ((rendered.visible_fractions >= 0) & (rendered.visible_fractions <= 1)).all()
        assert rendered.instances.max(initial=-1) < len(scene.objects)
        fractions = visible_fractions(replace(scene, plane=plane))
        np.testing.assert_allclose(fractions, rendered.visible_fractions)
    for item in scene.objects:
        assert silhouette(item, scene.K, scene.size).num_px >= 0
    return rendered


@settings(max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_any_triangle_soup(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(30, 3)) * 10 ** rng.uniform(-3, 1, 3)
    # Repeated vertices make faces without area, equal faces, and edges of many faces.
    faces = rng.integers(0, 30, (60, 3)).astype(np.int32)
    uv = rng.normal(size=(30, 2)).astype(np.float32)
    texture = rng.integers(0, 256, (5, 9, 3)).astype(np.uint8)
    surface = make_surface(Mesh(vertices, faces, *((uv, texture) if rng.random() < 0.5 else ())))
    pose = make_transform(random_rotation(rng), rng.normal(size=3))
    material = Material((0.9, 0.5, 0.1), 0.1, metallic=0.7, noise=0.1, grooves=Grooves())
    lights = tuple(Light(tuple(rng.normal(size=3))) for _ in range(int(rng.integers(0, 4))))
    K = np.array([[60.0, 0, 31.2], [0, 60.0, 24.1], [0, 0, 1]])
    background = np.full((48, 64, 3), 100, np.uint8)
    check(Scene(K, background, (SceneObject(surface, pose, material),), lights, Ambient()))


def test_vertices_on_the_camera_plane_and_at_the_camera(scene_of):
    corners = np.array([(0, 0, 0), (0.2, 0, 0), (0, 0.2, 0.5), (-0.2, -0.2, 1e-9), (0.1, 0, 1)])
    faces = np.array([(0, 1, 2), (1, 3, 2), (3, 4, 2), (0, 4, 1)], np.int32)
    check(scene_of(SceneObject(make_surface(Mesh(corners, faces)), np.eye(4))))


def test_a_mesh_around_camera_and_lights(scene_of, surface_of):
    room = trimesh.creation.box((0.5, 0.4, 1.0))
    lights = (Light((0, 0, 0)), Light(tuple(room.vertices[0])), Light((0.1, 0.1, 0.2)))
    for inside_out in (False, True):
        rendered = check(scene_of(SceneObject(surface_of(room), np.eye(4)), lights=lights))
        assert rendered.visible_fractions[0] == 0 or inside_out
        room.invert()


def test_extreme_sizes(scene_of, surface_of):
    for size, depth in ((1e-7, 0.1), (1e4, 3e4), (1e-3, 1e6), (0.1, 0.1001)):
        surface = surface_of(trimesh.creation.icosphere(2, size))
        pose = make_transform(np.eye(3), np.array([0.0, 0.0, depth]))
        check(scene_of(SceneObject(surface, pose, Material(grooves=Grooves(), noise=0.1))))


def test_nothing_but_faces_without_area(scene_of):
    flat = Mesh(np.zeros((3, 3)), np.array([(0, 1, 2), (0, 0, 0)], np.int32))
    line = Mesh(np.array([(0, 0, 0), (1, 0, 0), (2, 0, 0)], float), np.array([(0, 1, 2)], np.int32))
    pose = make_transform(np.eye(3), np.array([0.0, 0.0, 0.5]))
    for mesh in (flat, line):
        with np.errstate(all="raise"):
            surface = make_surface(mesh)
        assert check(scene_of(SceneObject(surface, pose))).visible_fractions[0] == 0


def test_the_time_for_a_hub_is_not_quadratic_in_its_faces(scene_of):
    # All pairs of these faces would take minutes.
    count = 50_000
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    around = np.arange(1, count + 1)
    faces = np.stack([np.zeros(count), around, np.roll(around, -1)], axis=1).astype(np.int32)
    surface = make_surface(Mesh(np.vstack([[0, 0, 0.2], rim]) * 0.1, faces))
    pose = make_transform(np.eye(3), np.array([0.0, 0.0, 0.4]))
    assert render(scene_of(SceneObject(surface, pose))).depth.max() > 0.3
