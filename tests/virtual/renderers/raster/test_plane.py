"""The supporting plane: depth, hidden objects, and the shadows on its image."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import make_transform, project
from dopepp.virtual import make_surface, render
from dopepp.virtual.renderers.raster import visible_fractions
from dopepp.virtual.renderers.raster.plane import hidden_sky
from dopepp.virtual.scene import Ambient, Light, Plane, SceneObject
from tests.parts.makers import mesh_of
from tests.virtual.conftest import even_light, pixel_rays

ANGLE = 0.7
NORMAL = np.array([0.0, -np.sin(ANGLE), -np.cos(ANGLE)])
"""The camera looks down at an angle; the plane's middle is 0.5 m away along the optical axis."""

PLANE = Plane(tuple(NORMAL), float(NORMAL[2] * 0.5))
IMAGE = {"size": (320, 240), "focal": 320.0}
DARK = even_light(0.0)


def on_plane(x, y, height):
    """A point in the camera frame, from plane coordinates around its middle."""
    side = np.array([1.0, 0, 0])
    return np.array([0, 0, 0.5]) + x * side + y * np.cross(NORMAL, side) + height * NORMAL


def box_at(x, y, height, extents):
    """A box whose bottom hovers over the plane."""
    side = np.array([1.0, 0, 0])
    rotation = np.stack([side, np.cross(NORMAL, side), NORMAL], axis=1)
    surface = make_surface(mesh_of(trimesh.creation.box(extents)))
    return SceneObject(surface, make_transform(rotation, on_plane(x, y, height + extents[2] / 2)))


def drawn(scene):
    return render(replace(scene, plane=PLANE))


def brightness(rendered, point):
    u, v = np.round(project(point, rendered.scene.K)).astype(int)
    assert rendered.instances[v, u] == -1
    return float(rendered.image[v, u, 1])


def test_depth_is_the_closed_form_and_stops_at_the_horizon(scene_of):
    # Looking nearly along the plane, the upper part of the image is above the horizon.
    normal = np.array([0.0, -np.cos(0.1), -np.sin(0.1)])
    scene = replace(scene_of(**IMAGE), plane=Plane(tuple(normal), -0.3))
    rendered = render(scene)
    expected = -0.3 / (pixel_rays(scene) @ normal)
    in_front = expected > 0
    assert 0.3 < in_front.mean() < 0.9
    assert (rendered.depth[~in_front] == 0).all()
    np.testing.assert_allclose(rendered.depth[in_front], expected[in_front], rtol=1e-5)
    assert (rendered.instances == -1).all()
    assert (rendered.image == scene.background).all()


def test_depth_is_right_around_objects(scene_of):
    item = box_at(0, 0, 0.0, (0.1, 0.1, 0.05))
    bare = drawn(scene_of(**IMAGE))
    rendered = drawn(scene_of(item, **IMAGE))
    empty = rendered.instances < 0
    np.testing.assert_array_equal(rendered.depth[empty], bare.depth[empty])
    assert (rendered.depth[~empty] < bare.depth[~empty]).all()
    assert rendered.visible_fractions[0] == 1.0


def test_parts_below_the_plane_are_hidden_and_reduce_the_visible_fraction(scene_of):
    # A box sunk in by half of its height, one below the plane and a whole one.
    sunk = box_at(-0.1, 0, -0.05, (0.05, 0.05, 0.1))
    below = box_at(0.1, 0, -0.2, (0.05, 0.05, 0.1))
    whole = box_at(0.0, 0.1, 0.0, (0.05, 0.05, 0.1))
    scene = replace(scene_of(sunk, below, whole, **IMAGE), plane=PLANE)
    rendered = render(scene)
    assert (rendered.visible_fractions[1], rendered.visible_fractions[2]) == (0, 1)
    assert (rendered.instances != 1).all()
    alone = render(replace(scene, plane=None, objects=(sunk,)))
    inside = alone.instances == 0
    heights = (pixel_rays(scene)[inside] @ NORMAL) * alone.depth[inside] - PLANE.offset
    assert rendered.visible_fractions[0] == pytest.approx((heights > 0).mean(), abs=0.01)
    assert 0.3 < rendered.visible_fractions[0] < 0.9
    np.testing.assert_array_equal(visible_fractions(scene), rendered.visible_fractions)


@pytest.mark.parametrize("which", [0, 1])
def test_a_shadow_lies_where_the_light_is_blocked(scene_of, which):
    item = box_at(0, 0, 0.10, (0.06, 0.06, 0.01))
    lamp = on_plane(-0.4, 0.1, 0.5)
    weak = Light((0.0, 0.0, 0.0), (1e-4, 1e-4, 1e-4))
    lights = [Light(tuple(lamp), (1, 1, 1), 0.6), weak]
    scene = scene_of(item, lights=tuple(lights[:: 1 - 2 * which]), ambient=DARK, **IMAGE)
    rendered = drawn(scene)
    # Similar triangles: the ray through the box's centre goes on by 0.105/(0.5 − 0.105).
    stretch = 0.105 / (0.5 - 0.105)
    middle = on_plane(0.4 * stretch, -0.1 * stretch, 0)
    assert brightness(rendered, middle) < 10
    half = 0.03 * (1 + stretch)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inner = on_plane(0.4 * stretch + 0.75 * half * dx, -0.1 * stretch + 0.75 * half * dy, 0)
        outer = on_plane(0.4 * stretch + 1.5 * half * dx, -0.1 * stretch + 1.5 * half * dy, 0)
        assert brightness(rendered, outer) == 90
        assert brightness(rendered, inner) < 15


def test_the_end_of_a_long_shadow_is_soft(scene_of):
    down = np.diag([1.0, -1.0, -1.0])  # the end of the shadow is parallel to the image's columns
    surface = make_surface(mesh_of(trimesh.creation.box((0.06, 0.06, 0.12))))
    item = SceneObject(surface, make_transform(down, [-0.12, 0.0, 0.54]))
    scene = scene_of(item, lights=(Light((-1.42, 0.0, -0.15)),), ambient=DARK, **IMAGE)
    row = render(replace(scene, plane=Plane((0.0, 0.0, -1.0), -0.6))).image[120, :, 1].astype(int)
    assert row.min() < 10
    assert row[row < 90].max() > 85  # no step to the background's 90


def test_the_tip_of_an_object_below_the_plane_is_quick():
    ball = make_surface(mesh_of(trimesh.creation.icosphere(4, 0.05)))
    tip = SceneObject(ball, make_transform(np.eye(3), [0, 0, 2e-5 - ball.points[:, 2].max()]))
    _, hidden = hidden_sky(np.eye(3, 4), [tip])
    assert 0 <= hidden.min() <= hidden.max() <= 1


def test_light_of_unblocked_lamps_remains(scene_of):
    # Two equal lamps at equal distances, one blocked, no sky: half of the light is left.
    item = box_at(0, 0, 0.10, (0.06, 0.06, 0.01))
    lamps = [Light(tuple(on_plane(x, 0, 0.4)), (0.5, 0.5, 0.5), 0.5) for x in (-0.4, 0.4)]
    shift = 0.4 * 0.105 / (0.4 - 0.105)
    rendered = drawn(scene_of(item, lights=tuple(lamps), ambient=DARK, **IMAGE))
    near, far = 0.4 - shift, 0.4 + shift
    share = (near**2 + 0.16) ** -1.5 / ((near**2 + 0.16) ** -1.5 + (far**2 + 0.16) ** -1.5)
    linear = ((90 / 255 + 0.055) / 1.055) ** 2.4 * share
    expected = 255 * (1.055 * linear ** (1 / 2.4) - 0.055)
    # At +shift the lamp at −0.4 is blocked, so the nearer one's share is left.
    assert brightness(rendered, on_plane(shift, 0, 0)) == pytest.approx(expected, abs=2)


def test_contact_darkens_the_sky_more_the_nearer(scene_of):
    # Beside a long wall of height h, at distance d, (1 + d/√(d² + h²))/2 of the sky is left.
    item = box_at(0, 0.05, 0, (0.3, 0.02, 0.05))
    sky = Ambient(tuple(NORMAL), (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    scene = scene_of(item, lights=(), ambient=sky, size=(640, 480), focal=640.0)
    rendered = drawn(scene)
    light = []
    for d in (0.012, 0.025, 0.05):
        code = brightness(rendered, on_plane(0, 0.04 - d, 0)) / 90
        light.append(code**2.2)
        assert light[-1] == pytest.approx((1 + d / np.hypot(d, 0.05)) / 2, abs=0.1)
    assert light[0] < light[1] < light[2]


def test_the_image_is_unchanged_far_from_objects(scene_of):
    item = box_at(0, 0, 0, (0.02, 0.02, 0.02))
    scene = scene_of(item, lights=(Light(tuple(on_plane(0, 0, 1.0))),), **IMAGE)
    rendered = drawn(scene)
    assert (rendered.image[:60] == 90).all()
    assert (rendered.image[-60:] == 90).all()
    assert rendered.image.min() < 85
