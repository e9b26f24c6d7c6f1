"""Colour: textures, normals, light and shadow, metal and grooves, against closed forms."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import make_transform, resize_camera
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.virtual import make_surface, render
from dopepp.virtual.presets.placement import FACING
from dopepp.virtual.scene import Ambient, Grooves, Light, Material, Panel, SceneObject
from dopepp.virtual.sensor import decode_srgb
from tests.virtual.conftest import even_light as even


def linear(codes):
    return np.asarray(decode_srgb(np.asarray(codes) / 255))


def facing(surface, place, *material):
    return SceneObject(surface, make_transform(FACING, np.array(place)), *material)


def test_texture_is_upright_and_rgb(scene_of, sheet):
    # Top half red, bottom half blue; the lower left texel block is green.
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32], texture[32:], texture[48:, :16] = (200, 0, 0), (0, 0, 200), (0, 200, 0)
    matt = Material((1, 1, 1), specular=0.0)
    item = facing(make_surface(sheet(0.2, texture)), (0, 0, 0.3), matt)
    image = render(scene_of(item, lights=(), ambient=even(0.4))).image
    assert (image[40, 80].argmax(), image[80, 100].argmax()) == (0, 2)
    assert image[105, 35].argmax() == 1
    assert (image[40, 80, 1:] == 0).all()


def test_texture_lookup_is_perspective_correct(scene_of, sheet):
    # A tilted sheet with a v ramp: the image must show the ray's own v, not an affine blend.
    ramp = np.repeat(np.linspace(255, 0, 256)[:, None], 256, axis=1).astype(np.uint8)
    surface = make_surface(sheet(0.2, np.stack([ramp] * 3, axis=-1)))
    tilt = rotation_vector_to_matrix(np.array([np.radians(60), 0, 0]))
    pose = make_transform(tilt @ FACING, np.array([0, 0, 0.25]))
    item = SceneObject(surface, pose, Material((0.4, 0.4, 0.4)))
    scene = scene_of(item, lights=(), ambient=even(1.0))
    rendered = render(scene)
    rows = np.nonzero(rendered.instances[:, 80] == 0)[0][4:-4]
    rays = np.stack([np.full(len(rows), 80), rows, np.ones(len(rows))]).T
    points = rays @ np.linalg.inv(scene.K).T * rendered.depth[rows, 80][:, None]
    v = ((points - pose[:3, 3]) @ pose[:3, :3])[:, 1] / 0.2 + 0.5
    srgb = np.clip(linear(rendered.image[rows, 80, 0]) / 0.4, 0, 1) ** (1 / 2.4) * 1.055 - 0.055
    np.testing.assert_allclose(srgb[v > 0.1], v[v > 0.1], atol=0.02)


def test_lambert_closed_form(scene_of, sheet):
    # Light from the camera on a matt sheet at the light's reach: albedo times intensity.
    item = facing(make_surface(sheet(0.2)), (0, 0, 0.5), Material((0.5, 0.5, 0.5), 1.0, 0.0))
    scene = scene_of(item, lights=(Light((0, 0, 0), (0.6, 0.6, 0.6), 0.5),), ambient=even(0.0))
    # Chalk still has Fresnel's grazing term, which is nil for light from the camera.
    assert linear(render(scene).image[60, 79, 0]) == pytest.approx(0.30, abs=0.006)


def test_strong_noise_stays_between_black_and_twice_the_colour(scene_of, sheet):
    matt = Material((0.3, 0.3, 0.3), specular=0.0, noise=10.0, noise_pitch=0.02)
    item = facing(make_surface(sheet(0.2)), (0, 0, 0.3), matt)
    image = linear(render(scene_of(item, lights=(), ambient=even(1.0))).image[40:80, 60:100])
    assert image.min() == pytest.approx(0.05 * 0.3, abs=0.004)
    assert image.max() == pytest.approx(2 * 0.3, abs=0.01)


def test_a_shadow_falls_where_the_light_is_blocked(scene_of, sheet, surface_of):
    floor = facing(make_surface(sheet(0.6)), (0, 0, 0.5))
    box = facing(surface_of(trimesh.creation.box((0.05, 0.05, 0.05))), (-0.05, 0, 0.4))
    light = Light((-0.25, 0, 0.2), (1, 1, 1), 0.4)
    lit = render(scene_of(floor, lights=(light,))).image.astype(int)
    shadowed = render(scene_of(floor, box, lights=(light,)))
    # The ray from the light through the box's centre meets the floor at x = 0.05.
    u = round(160 * 0.05 / 0.5 + 79.2)
    assert shadowed.instances[60, u] == 0
    assert shadowed.image[60, u, 0] < lit[60, u, 0] - 40
    assert abs(shadowed.image[60, 120, 0] - lit[60, 120, 0]) <= 1


@pytest.fixture(scope="module")
def tilted(sheet):
    """Make a sheet of 20 cm that faces the camera, or leans over by an angle."""

    def make(material, tilt=0.0, depth=0.4):
        turned = rotation_vector_to_matrix(np.array([tilt, 0, 0])) @ FACING
        surface = make_surface(replace(sheet(0.2), uv=None))
        return SceneObject(surface, make_transform(turned, [0, 0, depth]), material)

    return make


def test_metal_has_no_diffuse_light_and_a_coloured_mirror(scene_of, tilted):
    gold = Material((0.9, 0.6, 0.2), roughness=0.3, metallic=1.0)
    beside = Light((1.0, 0.0, 0.0), (0.8, 0.8, 0.8), 1.0)

    def middle(material, ambient, *lights):
        scene = scene_of(tilted(material), lights=lights, ambient=even(ambient))
        return render(scene).image[60, 79]

    plastic = replace(gold, metallic=0.0)
    assert middle(gold, 0.0, beside).max() < 35 < middle(plastic, 0.0, beside)[0]
    room = linear(middle(gold, 0.3))
    np.testing.assert_allclose(room, 0.3 * np.array(gold.colour), atol=0.004)
    flash = Light((0, 0, 0), (0.1, 0.1, 0.1), 0.4)
    rough = replace(gold, roughness=0.9)
    glint = linear(middle(rough, 0.0, flash))
    np.testing.assert_allclose(glint / glint[0], np.array(gold.colour) / 0.9, atol=0.05)


def test_ggx_peak_is_the_closed_form(scene_of, tilted):
    # Light, normal and view coincide: D V = 1/(4 α²) without π, and F is the albedo.
    metal = Material((0.8, 0.8, 0.8), roughness=0.8, metallic=1.0)
    flash = Light((0, 0, 0), (0.25, 0.25, 0.25), 0.4)
    code = render(scene_of(tilted(metal), lights=(flash,), ambient=even(0.0))).image[60, 79, 0]
    assert linear(code) == pytest.approx(0.25 * 0.8 / (4 * 0.64**2), rel=0.02)


def test_a_smooth_metal_mirrors_the_horizon(scene_of, tilted):
    sky = Ambient((0, -1, 0), (0.5, 0.5, 0.5), (0.1, 0.1, 0.1))
    steel = Material((0.9, 0.9, 0.9), roughness=0.1, metallic=1.0)
    up, down = (
        int(render(scene_of(tilted(steel, tilt), lights=(), ambient=sky)).image[60, 79, 0])
        for tilt in (0.5, -0.5)
    )
    assert abs(up - down) > 80


def test_a_panel_has_its_radiance_in_a_mirror_and_its_solid_angle_on_chalk(scene_of, tilted):
    panel = Panel((0, 0, -1), (1, 0, 0), 0.1, 0.3, (0.5, 0.5, 0.5))
    sky = replace(even(0.0), panels=(panel,))
    mirror = Material((0.8, 0.8, 0.8), roughness=0.05, metallic=1.0)
    chalk = Material((0.8, 0.8, 0.8), roughness=1.0, specular=0.0)
    tilt = 0.1  # radians; a ray along the normal's mirror image is at twice the angle
    for material, angle, expected in (
        (mirror, 0.0, 0.8 * 0.5),
        (mirror, tilt, 0.8 * 0.5 * np.exp(-0.5 * (np.sin(2 * tilt) / 0.1) ** 2)),
        (chalk, 0.0, 0.8 * 0.5 * 2 * 0.1 * 0.3),  # Gaussian of solid angle 2π · 0.1 · 0.3, over π
    ):
        scene = scene_of(tilted(material, angle), lights=(), ambient=sky)
        code = render(scene).image[60, 79, 0]
        assert linear(code) == pytest.approx(expected, rel=0.05, abs=0.002)


@pytest.mark.parametrize("irregularity", [0.0, 1.0])
def test_grooves_show_at_their_pitch(scene_of, tilted, irregularity):
    grooves = Grooves((1, 0, 0), 0.01, 0.3, irregularity)
    light = Light((0.5, 0, 0), (0.6, 0.6, 0.6), 0.6)
    scene = scene_of(tilted(Material(grooves=grooves)), lights=(light,), ambient=even(0.0))
    row = render(scene).image[60, 45:115, 0].astype(float)
    flat = render(replace(scene, objects=(tilted(Material()),))).image[60, 45:115, 0]
    assert (row - flat).std() > 4
    if irregularity == 0.0:
        # 0.01 m at 0.4 m is 4 px.
        power = np.abs(np.fft.rfft((row - flat - (row - flat).mean()) * np.hanning(70))) ** 2
        assert np.fft.rfftfreq(70)[power.argmax()] == pytest.approx(0.25, abs=0.015)


def test_lines_only_cross_their_axis(scene_of, tilted):
    # Seen along the axis there is nothing to tilt: a print's top face shows no layer lines.
    lines = Material(grooves=Grooves((0, 0, 1), 0.004, 0.5))
    scene = scene_of(tilted(lines), lights=(Light((0.3, 0, 0)),))
    plain = replace(scene, objects=(tilted(Material()),))
    np.testing.assert_array_equal(render(scene).image, render(plain).image)


@pytest.mark.parametrize("irregularity", [0.0, 1.0])
@pytest.mark.parametrize("pitch", [0.0004, 0.0021, 0.0026])
def test_fine_grooves_match_supersampling(scene_of, tilted, pitch, irregularity):
    # At 0.4 m a pixel spans 2.5 mm, so 2.6 mm is the worst beat with the pixels.
    grooves = Grooves((1, 0, 0), pitch, 0.15, irregularity)
    item = tilted(Material((0.5, 0.5, 0.5), 0.7, grooves=grooves), tilt=0.4)
    light = Light((0.3, -0.2, 0.0), (0.9, 0.9, 0.9), 0.5)
    scene = scene_of(item, lights=(light,), ambient=even(0.3), size=(80, 60))
    image = linear(render(scene).image)
    background = np.zeros((960, 1280, 3), np.uint8)
    large = replace(scene, K=resize_camera(scene.K, 16, 16), background=background)
    expected = cv2.resize(linear(render(large).image), scene.size, interpolation=cv2.INTER_AREA)
    inner = cv2.erode((render(scene).instances == 0).astype(np.uint8), np.ones((3, 3))) > 0
    error = (image - expected)[inner] / expected[inner].mean()
    # Irregular grooves have longer waves than their pitch, which a pixel may show or miss.
    assert np.sqrt((error**2).mean()) < (0.02 if irregularity == 0.0 else 0.06)


def test_unresolved_grooves_widen_the_highlight(scene_of, tilted):
    fine = Material((0.3, 0.3, 0.3), 0.25, 0.5, grooves=Grooves((1, 0, 0), 1e-5, 0.5))
    flash = Light((0, 0, 0), (0.02, 0.02, 0.02), 0.4)
    widths = []
    for material in (fine, replace(fine, grooves=None)):
        scene = scene_of(tilted(material, depth=0.2), lights=(flash,), ambient=even(0.0))
        row = linear(render(scene).image)[60, 20:140, 0]
        widths.append((row > (row.max() + row.min()) / 2).sum())
    assert widths[0] > 1.5 * widths[1]


def test_vertex_colours_blend_in_light(scene_of, sheet):
    # Left corners red, right corners blue; half of the light shows linear shares of either.
    colours = np.array([(255, 0, 0), (0, 0, 200), (0, 0, 200), (255, 0, 0)], np.uint8)
    mesh = replace(sheet(0.2), uv=None, colours=colours)
    matt = Material((0.4, 0.4, 0.4), specular=0.0)
    scene = scene_of(facing(make_surface(mesh), (0, 0, 0.3), matt), lights=(), ambient=even(1.0))
    rendered = render(scene)
    row = np.nonzero(rendered.instances[60] == 0)[0][3:-3]
    x = (row - scene.K[0, 2]) / scene.K[0, 0] * 0.3 / 0.2 + 0.5
    blue = 0.4 * linear(200) * x
    np.testing.assert_allclose(linear(rendered.image[60, row, 0]), 0.4 * (1 - x), atol=0.006)
    np.testing.assert_allclose(linear(rendered.image[60, row, 2]), blue, atol=0.006)
    assert not rendered.image[60, row, 1].any()
