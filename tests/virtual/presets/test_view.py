"""Working cameras: sizes in pixels, scales and windows, and advice in error messages."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix, focal_length, project, transform
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import make_part
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.presets.view import MIN_PX, View, read_lens
from dopepp.virtual.thinness import thin_width
from tests.parts.makers import mesh_of
from tests.virtual.conftest import draw_scenes

FOCAL = 640 / math.tan(math.radians(69 / 2))  # Of 1280 pixels that show 69°
K = camera_matrix(FOCAL, FOCAL, 650.0, 350.0)


def view(near=0.4, far=0.7, **changes):
    return replace(View((1280, 720), K, (near, far), "cam.yaml"), **changes)


def part(diameter):
    return replace(pivconnector(), name="bracket", diameter=diameter)


def test_a_part_has_the_pixels_of_the_pinhole():
    assert view().sizes_px([part(0.1)]) == pytest.approx((FOCAL * 0.1 / 0.7, FOCAL * 0.1 / 0.4))
    smallest, largest = view().sizes_px([part(0.1), part(0.05)], 0.5)
    assert (smallest, largest) == pytest.approx((FOCAL * 0.025 / 0.7, FOCAL * 0.05 / 0.4))


@given(st.floats(0.1, 1.0), st.floats(1.0, 6.0), st.floats(0.02, 0.2), st.booleans())
def test_chosen_scales_and_windows_suit_the_network(near, ratio, diameter, portrait):
    first, parts = view(near, near * ratio), [part(diameter)]
    if portrait:
        first = replace(first, size=(720, 1280), K=camera_matrix(FOCAL, FOCAL, 350.0, 650.0))
    try:
        first.check(parts)
    except UserError:
        return
    scale = first.scale_for(parts)
    assert 0 < scale <= 1
    smallest, largest = first.sizes_px(parts, scale)
    assert smallest >= min(45, first.sizes_px(parts)[0]) * 0.99
    assert smallest < 71
    if ratio < 2.4 and scale < 1:
        assert 44.5 < smallest <= largest < 111
    window = first.window_for(parts, scale)
    assert all(side % 32 == 0 for side in window)
    assert min(window) >= largest or min(window) >= scale * 720
    assert all(side < scale * whole + 32 for side, whole in zip(window, first.size, strict=True))
    assert (window[0] >= window[1]) != (portrait and window[0] != window[1])
    first.check(parts, scale)


def test_thin_features_have_five_pixels_at_the_largest_distance():
    rod = make_part("rod", mesh_of(trimesh.creation.cylinder(0.004, 0.16)))
    pixels = thin_width(rod) * rod.diameter * focal_length(K) / 0.7
    assert view().scale_for([rod]) == pytest.approx(5 / pixels, rel=0.01)
    assert view().scale_for([rod], (64, 64)) < 0.5 * view().scale_for([rod])


def test_a_given_window_limits_the_scale():
    parts = [part(0.1)]
    small = view().scale_for(parts, (64, 96))
    assert small < view().scale_for(parts)
    assert view().sizes_px(parts, small)[1] <= 64 / 1.29


def test_the_advised_distances_are_accepted():
    parts = [part(0.1)]
    large = r"from 0.1 m, where bracket \(100 mm across\) has 931 pixels .*1280×720.*"
    large += r"start working_distance at 0\.13$"
    with pytest.raises(UserError, match=large):
        view(0.1).check(parts)
    view(0.13).check(parts)
    small = r"to 9 m, where bracket .* has 10 pixels .*at least 25 pixels.*"
    small += r"end working_distance at 3\.724,"
    with pytest.raises(UserError, match=small):
        view(0.4, 9).check(parts)
    assert MIN_PX <= view(0.4, 3.724).sizes_px(parts)[0] < MIN_PX + 0.1
    view(0.4, 3.724).check(parts)


@pytest.mark.parametrize(
    ("distance", "message"),
    [
        ((0.8, 0.3), r"working_distance=\[0\.8, 0\.3\].*fix: write working_distance=\[0\.3,0\.8\]"),
        ((0.3,), r"\[nearest, farthest\] in metres"),
        ((0.3, 0.5, 0.8), r"\[nearest, farthest\] in metres"),
        ((0.0, 0.5), "from 0.02 to 100"),
        ((300.0, 800.0), "from 0.02 to 100"),
        ((0.3, math.nan), "from 0.02 to 100"),
    ],
)
def test_wrong_distances_are_refused(distance, message):
    with pytest.raises(UserError, match=message):
        view(distance=distance)


def test_a_camera_file_must_state_the_image_size(tmp_path, caplog):
    path, size = tmp_path / "cam.yaml", "image_width: 640\nimage_height: 480\n"
    rest = "camera_matrix: {rows: 3, cols: 3, data: [600, 0, 320, 0, 610, 240, 0, 0, 1]}\n"
    lens = "distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}\n"
    path.write_text(size + rest)
    with caplog.at_level(logging.INFO):
        assert read_lens(path)[0] == (640, 480)
    assert not caplog.records
    path.write_text(size + rest + lens)
    with caplog.at_level(logging.INFO):
        np.testing.assert_array_equal(read_lens(path)[1], camera_matrix(600, 610, 320, 240))
    assert "cam.yaml: its distortion is not rendered" in caplog.text
    path.write_text(rest)
    with pytest.raises(UserError, match=r"cam\.yaml, which does not state the size of its images"):
        read_lens(path)
    with pytest.raises(UserError, match="principal point inside the image"):
        view(size=(640, 360))


def test_the_description_states_sizes_and_warnings():
    lines = view().in_words([part(0.1)], 0.4, (224, 128))
    assert lines == [
        "cam.yaml: 1280×720 pixels, 69° × 42°, parts at 0.4 – 0.7 m",
        "the network's input is scaled by 0.4, and training uses windows of 224×128 pixels",
        "bracket: 53 – 93 pixels across; a pixel is 1.1 mm on the part at the nearest and 1.9 mm "
        "at the farthest",
    ]
    coarse = view(0.4, 3.0).in_words([part(0.1)])
    assert "parts are small" in coarse[-2]
    assert "the range of sizes is wide (1 : 7.5)" in coarse[-1]


@pytest.mark.parametrize("name", ["wide", "table", "quickstart"])
def test_scenes_show_parts_within_the_working_distance(name):
    parts, first = [servoholder()], view()
    scale = first.scale_for(parts)
    window = first.window_for(parts, scale)
    whole, small = first.whole(PRESETS[name], scale), first.window(PRESETS[name], scale, window)
    np.testing.assert_array_equal(whole.K, K)
    assert (whole.width, whole.height) == (1280, 720)
    assert whole.sensors.blur_px[1] * scale == pytest.approx(small.sensors.blur_px[1])
    beyond = 1.25 if name == "table" else 1.0
    for preset in (whole, small):
        for scene in draw_scenes(parts, preset, 4, 8):
            assert scene.size == (window if preset is small else (1280, 720))
            focal = scale * FOCAL if preset is small else FOCAL
            assert scene.K[0, 0] == pytest.approx(focal)
            assert scene.targets
            for number in scene.targets:
                item = scene.objects[number]
                middle = transform(item.T_cam_obj, item.part.cuboid)[8]
                assert 0.39 / beyond < middle[2] < 0.71 * beyond
                if name != "table":
                    pixels = project(transform(item.T_cam_obj, item.surface.hull), scene.K)
                    assert pixels.min() > -1
                    assert (pixels < scene.size).all()


def test_a_window_is_a_crop_of_the_scaled_image():
    """The window's K is that of the camera's image, scaled and moved by whole pixels."""
    item = view()
    scene = Factory([servoholder()], item.window(PRESETS["wide"], 0.4, (224, 128)), 1).scene(0, 0)
    scaled = camera_matrix(0.4 * FOCAL, 0.4 * FOCAL, 0.4 * 650.5 - 0.5, 0.4 * 350.5 - 0.5)
    corner = scaled[:2, 2] - scene.K[:2, 2]
    np.testing.assert_allclose(corner, np.round(corner), atol=1e-9)
    corner = np.round(corner)
    assert ((corner >= 0) & (corner <= (512 - 224, 288 - 128))).all()
