"""Colour: textures upright and in RGB, normals, light and shadow."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from dopepp.core.errors import UserError
from dopepp.geometry.camera import make_transform
from dopepp.parts.part import Mesh
from dopepp.virtual import Ambient, Light, Material, Scene, SceneObject, make_surface, render
from dopepp.virtual.presets.placement import FACING

MakeScene = Callable[..., Scene]
WHITE_ROOM = Ambient(above=(1.0, 1.0, 1.0), below=(1.0, 1.0, 1.0))


def facing(x: float, y: float, z: float) -> np.ndarray:
    return make_transform(FACING, np.array([x, y, z]))


def sheet(texture: np.ndarray | None, size: float = 0.2) -> Mesh:
    """A square in the xy plane whose uv grow with x and y; its front looks along +z."""
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)
    uv = (corners[:, :2] + 1) / 2
    return Mesh(corners * size / 2, np.array([(0, 1, 2), (0, 2, 3)], np.int32), uv, texture)


def test_texture_is_upright_and_rgb(scene_of: MakeScene) -> None:
    # Top half red, bottom half blue; the lower left texel block is green.
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32] = (200, 0, 0)
    texture[32:] = (0, 0, 200)
    texture[48:, :16] = (0, 200, 0)
    item = SceneObject(
        make_surface(sheet(texture)), facing(0, 0, 0.3), Material((1, 1, 1), specular=0.0)
    )
    dim = Ambient(above=(0.4, 0.4, 0.4), below=(0.4, 0.4, 0.4))
    image = render(scene_of(item, lights=(), ambient=dim)).image
    assert image[40, 80].argmax() == 0
    assert image[80, 100].argmax() == 2
    assert image[105, 35].argmax() == 1
    assert (image[40, 80, 1:] == 0).all()


def test_texture_lookup_is_perspective_correct(scene_of: MakeScene) -> None:
    # A tilted sheet with a v ramp: the image must show the ray's own v, not an affine blend.
    ramp = np.repeat(np.linspace(255, 0, 256)[:, None], 256, axis=1).astype(np.uint8)
    surface = make_surface(sheet(np.stack([ramp] * 3, axis=-1)))
    angle = np.radians(60)
    tilt = np.array(
        [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    )
    pose = make_transform(tilt @ FACING, np.array([0, 0, 0.25]))
    item = SceneObject(surface, pose, Material((0.4, 0.4, 0.4)))
    scene = scene_of(item, lights=(), ambient=WHITE_ROOM)
    rendered = render(scene)
    rows = np.nonzero(rendered.instances[:, 80] == 0)[0][4:-4]
    rays = np.stack([np.full(len(rows), 80), rows, np.ones(len(rows))]).T
    points = rays @ np.linalg.inv(scene.K).T * rendered.depth[rows, 80][:, None]
    v = ((points - pose[:3, 3]) @ pose[:3, :3])[:, 1] / 0.2 + 0.5
    code = rendered.image[rows, 80, 0] / 255.0
    linear = np.where(code < 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    srgb = np.clip(linear / 0.4, 0, 1) ** (1 / 2.4) * 1.055 - 0.055
    np.testing.assert_allclose(srgb[v > 0.1], v[v > 0.1], atol=0.02)


def test_the_side_that_faces_the_light_is_brighter(scene_of: MakeScene) -> None:
    ball = trimesh.creation.icosphere(4, 0.05)
    item = SceneObject(
        make_surface(Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))), facing(0, 0, 0.2)
    )
    for sign in (-1, 1):
        image = render(scene_of(item, lights=(Light((sign * 1.0, 0, 0)),))).image.astype(int)
        assert sign * (image[60, 100, 0] - image[60, 60, 0]) > 30


def test_lambert_closed_form(scene_of: MakeScene) -> None:
    # Light from the camera on a matt sheet at the light's reach: albedo times intensity.
    item = SceneObject(
        make_surface(sheet(None)), facing(0, 0, 0.5), Material((0.5, 0.5, 0.5), 1.0, 0.0)
    )
    dark = Ambient(above=(0, 0, 0), below=(0, 0, 0))
    scene = scene_of(item, lights=(Light((0, 0, 0), (0.6, 0.6, 0.6), 0.5),), ambient=dark)
    code = render(scene).image[60, 79, 0] / 255.0
    # Chalk still has Fresnel's grazing term, which is nil for light from the camera.
    assert ((code + 0.055) / 1.055) ** 2.4 == pytest.approx(0.30, abs=0.006)


def test_a_shadow_falls_where_the_light_is_blocked(scene_of: MakeScene) -> None:
    floor = SceneObject(make_surface(sheet(None, 0.6)), facing(0, 0, 0.5))
    blocker = trimesh.creation.box((0.05, 0.05, 0.05))
    box = SceneObject(
        make_surface(Mesh(np.asarray(blocker.vertices), np.asarray(blocker.faces))),
        facing(-0.05, 0, 0.4),
    )
    light = Light((-0.25, 0, 0.2), (1, 1, 1), 0.4)
    lit = render(scene_of(floor, lights=(light,))).image.astype(int)
    shadowed = render(scene_of(floor, box, lights=(light,)))
    # The ray from the light through the box's centre meets the floor at x = 0.05.
    u = round(160 * 0.05 / 0.5 + 79.2)
    assert shadowed.instances[60, u] == 0
    assert shadowed.image[60, u, 0] < lit[60, u, 0] - 40
    assert abs(shadowed.image[60, 120, 0] - lit[60, 120, 0]) <= 1


def test_flat_faces_have_no_shadow_acne(scene_of: MakeScene) -> None:
    floor = SceneObject(make_surface(sheet(None, 0.6)), facing(0, 0, 0.5), Material(specular=0.0))
    for light in (Light((2.0, 1.0, 0.0)), Light((-0.5, 0.5, 0.2)), Light((3, 0, 0.1), reach=3)):
        rendered = render(scene_of(floor, lights=(light,)))
        inner = rendered.image[5:-5, 5:-5, 0].astype(int)
        assert np.abs(np.diff(inner, axis=1)).max() <= 4


def test_cad_edges_stay_sharp_and_cylinders_are_smooth() -> None:
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    surface = make_surface(Mesh(np.asarray(box.vertices), np.asarray(box.faces)))
    corners = surface.vertices[surface.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    np.testing.assert_allclose(surface.normals, flat[:, None].repeat(3, axis=1), atol=1e-6)
    tube = trimesh.creation.cylinder(0.05, 0.1, sections=24)
    surface = make_surface(Mesh(np.asarray(tube.vertices), np.asarray(tube.faces)))
    positions = surface.vertices[surface.faces]
    side = np.abs(surface.normals[..., 2]) < 0.5
    radial = positions[side] * (1, 1, 0)
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    np.testing.assert_allclose(surface.normals[side], radial, atol=0.02)
    np.testing.assert_allclose(np.abs(surface.normals[~side][:, 2]), 1, atol=1e-6)


def test_split_vertices_are_closed_and_smooth_again() -> None:
    # STL gives every triangle vertices of its own.
    ball = trimesh.creation.icosphere(2, 0.05)
    soup = np.asarray(ball.triangles).reshape(-1, 3)
    surface = make_surface(Mesh(soup, np.arange(len(soup), dtype=np.int32).reshape(-1, 3)))
    assert surface.closed
    outward = surface.vertices[surface.faces]
    outward = outward / np.linalg.norm(outward, axis=2, keepdims=True)
    np.testing.assert_allclose(surface.normals, outward, atol=0.03)


def test_open_and_inside_out_meshes_are_not_closed() -> None:
    ball = trimesh.creation.icosphere(1, 0.05)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    assert make_surface(Mesh(vertices, faces)).closed
    assert not make_surface(Mesh(vertices, faces[1:])).closed
    assert not make_surface(Mesh(vertices, faces[:, ::-1])).closed


def test_stretching_keeps_normals_upright() -> None:
    ball = trimesh.creation.icosphere(3, 1.0)
    surface = make_surface(Mesh(np.asarray(ball.vertices), np.asarray(ball.faces)))
    scale = np.array([0.1, 0.2, 0.05])
    stretched = surface.scaled(scale)
    # The gradient of the ellipsoid's equation.
    outward = stretched.vertices[stretched.faces] / scale**2
    outward /= np.linalg.norm(outward, axis=2, keepdims=True)
    np.testing.assert_allclose(stretched.normals, outward, atol=0.05)


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        (np.zeros((3, 3)), np.zeros((0, 3), np.int32)),
        (np.array([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])),
    ],
)
def test_meshes_that_cannot_be_rendered_are_refused(
    vertices: np.ndarray, faces: np.ndarray
) -> None:
    with pytest.raises(UserError, match="at least one face and finite vertices"):
        make_surface(Mesh(vertices, faces))


def test_degenerate_triangles_do_no_harm(scene_of: MakeScene) -> None:
    mesh = sheet(None)
    faces = np.vstack([mesh.faces, [[0, 0, 1], [1, 1, 1]]]).astype(np.int32)
    with np.errstate(all="raise"):
        surface = make_surface(Mesh(mesh.vertices, faces))
    assert np.isfinite(surface.normals).all()
    first = render(
        scene_of(SceneObject(make_surface(Mesh(mesh.vertices, mesh.faces)), facing(0, 0, 0.3)))
    )
    second = render(scene_of(SceneObject(surface, facing(0, 0, 0.3))))
    np.testing.assert_array_equal(first.image, second.image)
