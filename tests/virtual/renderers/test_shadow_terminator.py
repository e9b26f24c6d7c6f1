"""A smooth body of few flat triangles throws no shadow on itself where its normals face a light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import random_rotation
from dopepp.parts.part import Mesh
from dopepp.virtual import Ambient, Light, Material, Scene, SceneObject, make_surface, render
from dopepp.virtual.renderers.raster import shadow as shadow_module
from dopepp.virtual.renderers.raster.fragments import _corner_heights
from dopepp.virtual.renderers.raster.shadow import ShadowMap, shadow_map

MakeScene = Callable[..., Scene]
BODIES = {
    "ball": trimesh.creation.icosphere(subdivisions=1, radius=0.05),
    "rod": trimesh.creation.cylinder(radius=0.03, height=0.1, sections=16),
}


def without_casters(*arguments: object) -> ShadowMap:
    """A shadow map that nothing was drawn into."""
    drawn = shadow_map(*arguments)  # type: ignore[arg-type]
    return replace(drawn, inverse_depth=np.zeros_like(drawn.inverse_depth))


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("winding", [1, -1])
def test_a_convex_smooth_body_has_no_shadow_on_it(
    scene_of: MakeScene, monkeypatch: pytest.MonkeyPatch, name: str, winding: int
) -> None:
    # Inside out, the mesh is not closed, so its triangles are drawn from both sides.
    body = BODIES[name]
    mesh = Mesh(np.asarray(body.vertices), np.asarray(body.faces, np.int32)[:, ::winding])
    surface = make_surface(mesh)
    rng = np.random.default_rng(3)
    black = Ambient(above=(0.0, 0.0, 0.0), below=(0.0, 0.0, 0.0))
    for _ in range(6):
        pose = make_transform(random_rotation(rng), np.array([0.0, 0.0, 0.18]))
        side = rng.normal(size=2)
        x, y = side / np.linalg.norm(side)
        item = SceneObject(surface, pose, Material((0.9, 0.9, 0.9), 1.0, specular=0.0))
        lights = (Light((x, y, 0.3)),)
        scene = scene_of(item, lights=lights, ambient=black, size=(640, 480), focal=600.0)
        rendered = render(scene)
        with_shadow = rendered.image.astype(int)
        with monkeypatch.context() as patch:
            patch.setattr(shadow_module, "shadow_map", without_casters)
            without = render(scene).image.astype(int)
        # Dots of shadow would be dozens of levels dark.
        assert np.abs(with_shadow - without).max() <= 3
        assert without[rendered.instances == 0].max() > 60


def test_heights_are_distances_from_the_corners_tangent_planes() -> None:
    rng = np.random.default_rng(0)
    vertices, normals = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    share = rng.dirichlet(np.ones(3))
    point = share @ vertices
    heights = _corner_heights.py_func(vertices, 0, 1, 2, normals)  # type: ignore[attr-defined]
    for corner, (i, j) in enumerate(((1, 2), (0, 2), (0, 1))):
        below = share[i] * heights[2 * corner] + share[j] * heights[2 * corner + 1]
        np.testing.assert_allclose(below, (vertices[corner] - point) @ normals[corner])
