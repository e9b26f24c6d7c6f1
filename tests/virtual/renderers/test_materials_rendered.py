"""Metal, layer lines and brushing: closed forms, and no aliasing however fine the grooves are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from dopepp.geometry.camera import make_transform, resize_camera
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.parts.part import Mesh
from dopepp.virtual import (
    Ambient,
    Grooves,
    Light,
    Material,
    Scene,
    SceneObject,
    make_surface,
    render,
)  # fmt: skip
from dopepp.virtual.presets.placement import FACING

MakeScene = Callable[..., Scene]
DARK = Ambient(above=(0, 0, 0), below=(0, 0, 0))
EVEN = Ambient(above=(0.3, 0.3, 0.3), below=(0.3, 0.3, 0.3))


def sheet(material: Material, tilt: float = 0.0, depth: float = 0.4) -> SceneObject:
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float) * 0.1
    surface = make_surface(Mesh(corners, np.array([(0, 1, 2), (0, 2, 3)], np.int32)))
    turned = rotation_vector_to_matrix(np.array([tilt, 0, 0])) @ FACING
    return SceneObject(surface, make_transform(turned, np.array([0, 0, depth])), material)


def linear(codes: np.ndarray) -> np.ndarray:
    codes = np.asarray(codes) / 255.0
    return np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)


def test_metal_has_no_diffuse_light_and_a_coloured_mirror(scene_of: MakeScene) -> None:
    gold = Material((0.9, 0.6, 0.2), roughness=0.3, metallic=1.0)
    beside = Light((1.0, 0.0, 0.0), (0.8, 0.8, 0.8), 1.0)
    away = render(scene_of(sheet(gold), lights=(beside,), ambient=DARK)).image[60, 79]
    plastic = render(scene_of(sheet(replace(gold, metallic=0.0)), lights=(beside,), ambient=DARK))
    assert away.max() < 35 < plastic.image[60, 79, 0]
    room = linear(render(scene_of(sheet(gold), lights=(), ambient=EVEN)).image[60, 79])
    np.testing.assert_allclose(room, 0.3 * np.array(gold.colour), atol=0.004)
    flash = Light((0, 0, 0), (0.1, 0.1, 0.1), 0.4)
    rough = replace(gold, roughness=0.9)
    glint = linear(render(scene_of(sheet(rough), lights=(flash,), ambient=DARK)).image[60, 79])
    np.testing.assert_allclose(glint / glint[0], np.array(gold.colour) / 0.9, atol=0.05)


def test_ggx_peak_is_the_closed_form(scene_of: MakeScene) -> None:
    # Light, normal and view coincide: D V = 1/(4 α²) without π, and F is the albedo.
    metal = Material((0.8, 0.8, 0.8), roughness=0.8, metallic=1.0)
    flash = Light((0, 0, 0), (0.25, 0.25, 0.25), 0.4)
    code = render(scene_of(sheet(metal), lights=(flash,), ambient=DARK)).image[60, 79, 0]
    assert linear(code) == pytest.approx(0.25 * 0.8 / (4 * 0.64**2), rel=0.02)


def test_a_smooth_metal_mirrors_the_horizon(scene_of: MakeScene) -> None:
    sky = Ambient((0, -1, 0), (0.5, 0.5, 0.5), (0.1, 0.1, 0.1))
    steel = Material((0.9, 0.9, 0.9), roughness=0.1, metallic=1.0)
    up, down = (
        int(render(scene_of(sheet(steel, tilt), lights=(), ambient=sky)).image[60, 79, 0])
        for tilt in (0.5, -0.5)
    )
    assert abs(up - down) > 80


@pytest.mark.parametrize("irregularity", [0.0, 1.0])
def test_grooves_show_at_their_pitch(scene_of: MakeScene, irregularity: float) -> None:
    grooves = Grooves((1, 0, 0), 0.01, 0.3, irregularity)
    light = Light((0.5, 0, 0), (0.6, 0.6, 0.6), 0.6)
    scene = scene_of(sheet(Material(grooves=grooves)), lights=(light,), ambient=DARK)
    row = render(scene).image[60, 45:115, 0].astype(float)
    flat = render(replace(scene, objects=(sheet(Material()),))).image[60, 45:115, 0]
    assert (row - flat).std() > 4
    if irregularity == 0.0:
        # 0.01 m at 0.4 m is 4 px.
        power = np.abs(np.fft.rfft((row - flat - (row - flat).mean()) * np.hanning(70))) ** 2
        assert np.fft.rfftfreq(70)[power.argmax()] == pytest.approx(0.25, abs=0.015)


def test_lines_only_cross_their_axis(scene_of: MakeScene) -> None:
    # Seen along the axis there is nothing to tilt: a print's top face shows no layer lines.
    lines = Material(grooves=Grooves((0, 0, 1), 0.004, 0.5))
    scene = scene_of(sheet(lines), lights=(Light((0.3, 0, 0)),))
    np.testing.assert_array_equal(
        render(scene).image, render(replace(scene, objects=(sheet(Material()),))).image
    )


@pytest.mark.parametrize("irregularity", [0.0, 1.0])
@pytest.mark.parametrize("pitch", [0.0004, 0.0021, 0.0026])
def test_fine_grooves_match_supersampling(
    scene_of: MakeScene, pitch: float, irregularity: float
) -> None:
    # At 0.4 m a pixel spans 2.5 mm, so 2.6 mm is the worst beat with the pixels.
    grooves = Grooves((1, 0, 0), pitch, 0.15, irregularity)
    item = sheet(Material((0.5, 0.5, 0.5), 0.7, grooves=grooves), tilt=0.4)
    light = Light((0.3, -0.2, 0.0), (0.9, 0.9, 0.9), 0.5)
    scene = scene_of(item, lights=(light,), ambient=EVEN)
    image = linear(render(scene).image)
    large = Scene(
        resize_camera(scene.K, 16, 16), np.zeros((1920, 2560, 3), np.uint8), (item,), (light,), EVEN
    )
    expected = cv2.resize(linear(render(large).image), scene.size, interpolation=cv2.INTER_AREA)
    inner = cv2.erode((render(scene).instances == 0).astype(np.uint8), np.ones((3, 3))) > 0
    error = (image - expected)[inner] / expected[inner].mean()
    # Irregular grooves have longer waves than their pitch, which a pixel may show or miss.
    assert np.sqrt((error**2).mean()) < (0.02 if irregularity == 0.0 else 0.06)


def test_unresolved_grooves_widen_the_highlight(scene_of: MakeScene) -> None:
    fine = Material((0.3, 0.3, 0.3), 0.25, 0.5, grooves=Grooves((1, 0, 0), 1e-5, 0.5))
    flash = Light((0, 0, 0), (0.02, 0.02, 0.02), 0.4)
    widths = []
    for material in (fine, replace(fine, grooves=None)):
        image = linear(
            render(scene_of(sheet(material, depth=0.2), lights=(flash,), ambient=DARK)).image
        )
        row = image[60, 20:140, 0]
        widths.append((row > (row.max() + row.min()) / 2).sum())
    assert widths[0] > 1.5 * widths[1]
    noise = np.diff(row)
    assert np.isfinite(noise).all()
