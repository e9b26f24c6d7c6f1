"""Presets: ranges of random scenes, cameras of other image sizes, changes by plain values."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from dopepp.core.errors import UserError
from dopepp.geometry.camera import project, resize_camera, transform
from dopepp.geometry.rotation import is_rotation, random_rotation
from dopepp.parts.part import make_part
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.body import Distractors
from dopepp.virtual.presets import preset_of, resolve_base
from dopepp.virtual.presets.placement import (
    DistancePlacement,
    FacingTurning,
    FillPlacement,
    OffsetPlacement,
    UprightTurning,
    WorkingPlacement,
)
from dopepp.virtual.presets.table import Table
from dopepp.virtual.renderers.raster import visible_fractions
from tests.virtual.conftest import draw_scenes


def angles(rotation):
    """(in-plane, tilt) in degrees, from the rotation alone.

    The tilt rotates about an axis in the image plane, so the twist about the optical axis of
    R·FACINGᵀ is the in-plane angle (swing-twist decomposition).
    """
    tilt = np.degrees(np.arccos(np.clip(-rotation[2, 2], -1, 1)))
    swing = rotation @ np.diag([1.0, -1.0, -1.0])
    in_plane = np.degrees(np.arctan2(swing[1, 0] - swing[0, 1], swing[0, 0] + swing[1, 1]))
    return float(in_plane), float(tilt)


def test_quickstart_poses_and_lights(parts):
    quickstart_scenes = draw_scenes(parts, PRESETS["quickstart"], 5, 200)
    rotations = (scene.objects[0].T_cam_obj[:3, :3] for scene in quickstart_scenes)
    in_plane, tilt = zip(*map(angles, rotations), strict=True)
    assert 42 < np.abs(in_plane).max() <= 45 + 1e-6
    assert 37 < max(tilt) <= 40 + 1e-6
    assert {s.objects[0].label for s in quickstart_scenes} == {"servoholder", "pivconnector"}
    assert {len(s.objects) for s in quickstart_scenes} == {1, 2, 3}
    ranges = PRESETS["quickstart"].lighting
    for scene in quickstart_scenes:
        assert scene.plane is None
        hull = transform(scene.objects[0].T_cam_obj, scene.objects[0].surface.hull)
        pixels = project(hull, scene.K)
        assert 0.59 < np.ptp(pixels, axis=0).max() / 128 < 0.96
        assert -1 < pixels.min() < pixels.max() < 128
        assert ranges.num_lights[0] <= len(scene.lights) <= ranges.num_lights[1]
        for number, light in enumerate(scene.lights):
            low, high = ranges.fill_intensity if number else ranges.key_intensity
            luminance = np.array(light.intensity) @ [0.2126, 0.7152, 0.0722]
            assert low * (1 - ranges.tint) <= luminance <= high * (1 + ranges.tint)
            assert light.reach > 0


def test_the_limited_view_skews_neither_lateral_positions_nor_rotations(parts):
    drawn = draw_scenes(parts, PRESETS["paper"].resized(80, 60), 90125, 600)
    assert {len(scene.objects) for scene in drawn} == {1}
    T = np.array([scene.objects[0].T_cam_obj for scene in drawn])
    x, y, z = T[:, :3, 3].T
    assert 0.10 <= z.min() < 0.12 < 0.28 < z.max() <= 0.30
    for aside in (x, y):
        assert np.abs(aside).max() <= 0.15
        assert kstest(np.abs(aside) / 0.15, "uniform").pvalue > 0.05
        assert np.abs(aside).mean() == pytest.approx(0.075, abs=0.003)
    # A sphere's area is uniform over its height.
    assert kstest((T[:, 2, 2] + 1) / 2, "uniform").pvalue > 0.05
    # At 90° the image shows the box's whole width where y is small and z large: no skew there.
    whole = (np.abs(y) < 0.05) & (np.abs(x) < 0.05)
    assert z[whole].mean() == pytest.approx(0.2, abs=0.02)
    assert z.mean() == pytest.approx(0.219, abs=0.005)


def test_a_lateral_position_outside_the_view_is_drawn_again(sized_box):
    preset = replace(PRESETS["paper"].resized(80, 60), placement=OffsetPlacement(lateral=0.25))
    drawn = draw_scenes([sized_box("large", 3)], preset, 0, 20)
    places = np.array([scene.objects[0].T_cam_obj[:3, 3] for scene in drawn])
    # Of the drawn ones, a tenth is never in the image.
    assert (np.abs(places[:, 1]) < 0.225).all()


@pytest.mark.parametrize("name", sorted({*PRESETS} - {"heap"}))  # physics decides there
def test_centroids_lie_inside_and_in_front(name, box_part):
    preset = PRESETS[name]
    small = preset.resized(max(preset.width // 8, 32), max(preset.height // 8, 24))
    for scene in draw_scenes([box_part], small, 5, 60):
        if name == "ycb":
            assert 0.5 <= scene.objects[0].T_cam_obj[2, 3] <= 1.2
        width, height = scene.size
        for index in scene.targets:
            u, v = scene.keypoints(index)[8]
            assert -0.5 <= u < width - 0.5
            assert -0.5 <= v < height - 0.5
            corners = transform(scene.objects[index].T_cam_obj, scene.objects[index].surface.hull)
            assert corners[:, 2].min() > 0.01


def test_resized_draws_the_same_poses(box_part):
    preset = replace(PRESETS["ycb"], distractors=Distractors((0, 0)), min_visible_fraction=0.0)
    both = (draw_scenes([box_part], p, 3, 5) for p in (preset, preset.resized(320, 240)))
    large, small = ([scene.objects[0].T_cam_obj for scene in drawn] for drawn in both)
    np.testing.assert_allclose(large, small, atol=1e-9)


def test_the_shipped_presets_are_a_mapping(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("base: paper\n")
    for name in ("unknown", str(path)):  # preset_of reads a file
        assert name not in PRESETS
        assert PRESETS.get(name) is None
    assert preset_of(str(path)).name == "mine"


@pytest.mark.parametrize("name", sorted(PRESETS))
@pytest.mark.parametrize("size", [(416, 416), (1280, 720), (720, 1280), (320, 240), (100, 333)])
def test_reframing_keeps_square_pixels_and_the_view_along_the_shorter_side(name, size):
    preset = PRESETS[name]
    sized = preset.reframed(*size)
    assert (sized.width, sized.height) == size
    before, after = preset.K, sized.K
    assert after[1, 1] / after[0, 0] == pytest.approx(before[1, 1] / before[0, 0], rel=1e-12)
    scale = min(size) / min(preset.width, preset.height)
    assert after[0, 0] == pytest.approx(scale * before[0, 0], rel=1e-12)
    # The principal point is as far from the middle as it was.
    aside = before[:2, 2] - (np.array([preset.width, preset.height]) - 1) / 2
    np.testing.assert_allclose(after[:2, 2] - (np.array(size) - 1) / 2, scale * aside, atol=1e-9)
    np.testing.assert_allclose(sized.sensors.blur_px, scale * np.array(preset.sensors.blur_px))


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
@pytest.mark.parametrize("factor", [0.25, 3 / 8, 2.0])
def test_reframing_to_the_same_aspect_ratio_equals_resizing(preset, factor):
    size = round(factor * preset.width), round(factor * preset.height)
    resized = preset.resized(*size)
    assert preset.reframed(*size) == resized
    np.testing.assert_allclose(resized.K, resize_camera(preset.K, factor, factor))
    assert resized.sensors.read_noise == preset.sensors.read_noise


def test_windows_cover_the_image():
    preset = replace(PRESETS["ycb"], window=(224, 160))
    rng = np.random.default_rng(3)
    corners = []
    for _ in range(2000):
        K, size = preset.draw_camera(rng)
        assert size == (224, 160)
        np.testing.assert_array_equal(K[:2, :2], preset.K[:2, :2])
        corners.append(preset.K[:2, 2] - K[:2, 2])
    corners = np.array(corners)
    assert corners.min() == 0
    np.testing.assert_array_equal(corners.max(axis=0), [640 - 224, 480 - 160])
    # A point of the window is anywhere in the image, at its borders half as often.
    points = corners + rng.uniform(0, 1, corners.shape) * (224, 160)
    shares = np.histogram(points[:, 0], 8, (0, 640))[0] / 2000
    assert 0.06 < shares.min() < shares.max() < 0.2


def test_a_window_larger_than_the_image_is_centred_on_it():
    K, size = replace(PRESETS["quickstart"], window=(160, 96)).draw_camera(np.random.default_rng(0))
    assert size == (160, 96)
    assert K[0, 2] == PRESETS["quickstart"].K[0, 2] + 16
    assert 0 <= PRESETS["quickstart"].K[1, 2] - K[1, 2] <= 32


@given(st.integers(0, 10_000), st.floats(-3, 3), st.floats(0.5, 2.0), st.integers(200, 800))
def test_working_placement_keeps_the_distance_and_fits_the_image(seed, origin, nearest, width):
    rng = np.random.default_rng(seed)
    hull = rng.uniform(-0.05, 0.05, (30, 3)) + origin  # wherever the file has its origin
    K = np.array([[width, 0, 0.4 * width], [0, 1.1 * width, 100], [0, 0, 1]])
    place = WorkingPlacement(nearest, 2 * nearest).draw(rng, K, (width, 200), hull)
    there = hull + place
    middle = (there[:, 2].min() + there[:, 2].max()) / 2
    assert nearest - 1e-9 <= middle <= 2 * nearest + 1e-9
    pixels = project(there, K) + 0.5
    assert pixels.min() > -1e-6
    assert (pixels < np.array([width, 200]) + 1e-6).all()


def test_a_placement_is_that_of_the_part_wherever_its_file_has_the_origin(parts):
    part = parts[0]
    shift = np.array([0.3, -0.2, 0.1])
    moved = make_part(part.name, replace(part.mesh, vertices=part.mesh.vertices + shift))
    preset = replace(
        PRESETS["paper"].resized(160, 120),
        placement=DistancePlacement(0.2, 0.5),
        targets_per_image=(1, 1),
    )
    for scene in draw_scenes([moved], preset, 2, 10):
        (number,) = scene.targets
        vertices = part.mesh.vertices + shift
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        middle = transform(scene.objects[number].T_cam_obj, centre[None])
        assert 0.2 <= middle[0, 2] <= 0.5
        assert (np.abs(project(middle, scene.K) / [160, 120] - 0.5) < 0.41).all()


def test_depths_hold(parts):
    preset = replace(PRESETS["table"].resized(160, 120), depths=(0.4, 0.42))
    for scene in draw_scenes(parts, preset, 2, 5):
        for number in scene.targets:
            middle = transform(scene.objects[number].T_cam_obj, scene.objects[number].part.cuboid)
            assert 0.4 <= middle[8, 2] <= 0.42


def test_field_of_view_follows_the_width():
    wide = replace(PRESETS["paper"], width=320, height=240)
    assert wide.K[0, 0] == pytest.approx(160.0)
    np.testing.assert_allclose(wide.K[:2, 2], [159.5, 119.5])
    assert PRESETS["paper"].K[0, 0] == pytest.approx(320.0)


SIDES = st.integers(16, 800)


@given(st.integers(0, 10_000), st.floats(0.1, 1.0), SIDES, SIDES, st.floats(0.3, 4.0))
def test_fill_placement_reaches_its_share(seed, share, width, height, focal):
    rng = np.random.default_rng(seed)
    hull = rng.uniform(-1, 1, (30, 3)) * rng.uniform(0.01, 0.5, 3) @ random_rotation(rng).T
    K = np.array([[focal * width, 0, width * 0.45], [0, focal * width, height * 0.6], [0, 0, 1]])
    placement = FillPlacement(share, share)
    offset = placement.draw(rng, K, (width, height), hull)
    pixels = project(hull + offset, K)
    assert np.isfinite(pixels).all()
    assert (np.ptp(pixels, axis=0) / (width, height)).max() == pytest.approx(share, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"targets_per_image": (2, 1)}, "targets_per_image"),
        ({"width": 4}, "width=4 of quickstart; allowed: an integer from 8"),
        ({"min_visible_fraction": float("nan")}, "min_visible_fraction=nan.* from 0 to 0.95"),
        ({"horizontal_fov_deg": 179.0}, r"from 5 to 150 \(degrees\)"),
        ({"intrinsics_px": (300.0, 300.0, 900.0, 20.0)}, "principal point inside"),
    ],
)
def test_wrong_presets_are_refused(change, message):
    with pytest.raises(UserError, match=message):
        replace(PRESETS["quickstart"], **change)
    with pytest.raises(UserError, match="'shelf'; allowed: bin, heap, paper, quickstart"):
        preset_of("shelf", {})


@pytest.mark.parametrize("name", sorted({*PRESETS} - {"heap"}))
def test_a_stated_visibility_holds(name, parts):
    preset = replace(PRESETS[name].resized(320, 240), distractors=Distractors((0, 8)))
    for scene in draw_scenes(parts, preset, 3, 10):
        assert visible_fractions(scene)[list(scene.targets)].min() >= preset.min_visible_fraction


@pytest.mark.parametrize(
    ("name", "size", "distance"),
    [
        ("paper", 40, 0),
        ("table", 40, 0.5),
        ("bin", 40, 0.5),
        ("table", 0.06, 20),
        ("bin", 0.06, 20),
    ],
)
def test_a_part_that_cannot_be_shown_is_an_error(name, size, distance, sized_box):
    table = Table(distance=(distance, distance)) if distance else None
    preset = replace(PRESETS[name], table=table)
    with pytest.raises(UserError, match="part wrong of diameter"):
        Factory([sized_box("wrong", size)], preset, 0).scene(0, 0)


def test_several_targets_do_not_pierce_each_other(parts):
    preset = replace(
        PRESETS["paper"], targets_per_image=(0, 3), min_visible_fraction=0.2,
        placement=DistancePlacement(0.2, 0.5),
    )  # fmt: skip
    drawn = draw_scenes(parts, preset.resized(160, 120), 2, 20)
    assert {len(scene.targets) for scene in drawn} == {0, 1, 2, 3}
    for scene in drawn:
        assert visible_fractions(scene)[list(scene.targets)].min(initial=1) >= 0.2


def test_nested_fields_change_and_the_others_stay():
    changes = {
        "targets_per_image": [0, 2],
        "materials": {"metal_share": 1, "layer_pitch": [0.0001, 0.0002]},
        "table": {"distance": (0.3, 0.4), "heaped": True},
        "sensors": {"jpeg_quality": [50, 60]},
    }
    original = PRESETS["table"]
    preset = preset_of("table", changes)
    assert preset == replace(
        original,
        targets_per_image=(0, 2),
        materials=replace(original.materials, metal_share=1.0, layer_pitch=(0.0001, 0.0002)),
        table=replace(Table(), distance=(0.3, 0.4), heaped=True),
        sensors=replace(original.sensors, jpeg_quality=(50, 60)),
    )
    assert isinstance(preset.materials.metal_share, float)
    assert preset_of("table", {}) == original


def test_groups_are_added_and_removed():
    assert preset_of("paper", {"table": {}}).table == Table()
    assert preset_of("paper", {"table": {"roll_deg": 5}}).table == Table(roll_deg=5.0)
    assert preset_of("bin", {"table": None}).table is None
    narrow = preset_of("ycb", {"intrinsics_px": None, "horizontal_fov_deg": 40})
    assert narrow.intrinsics_px is None
    assert narrow.K[0, 0] == pytest.approx(320 / 0.36397, rel=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"colour": 1}, "colour=1; allowed: name, width"),
        (
            {"materials": {"metal": 1}},
            "materials.metal=1; allowed: albedo, .*; fix: write metal_share",
        ),
        ({"materials": 3}, "materials=3; allowed: a mapping"),
        ({"materials": {"metal_share": "0.2"}}, "materials.metal_share='0.2'"),
        ({"materials": {"metal_share": None}}, "materials.metal_share=None"),
        ({"materials": {"metal_share": 1.1}}, "metal_share=1.1; allowed: a number from 0 to 1"),
        ({"lighting": {"num_lights": [1]}}, r"lighting.num_lights=\[1\]"),
        ({"lighting": {"num_lights": 2}}, "smallest <= largest"),
        ({"lighting": {"num_lights": [1.5, 2.0]}}, "smallest <= largest"),
        ({"lighting": {"key_intensity": [1.0, 0.5]}}, "smallest <= largest"),
        ({"sensors": {"blur_px": [float("nan"), 1]}}, "sensors.blur_px=.nan, 1"),
        ({"placement": {"distance": 10**400}}, "placement.distance=1000"),
        ({"placement": {"distance": 0.05}}, "axial < distance"),
        ({"table": {"heaped": 1}}, "table.heaped=1; allowed: true or false"),
        ({"intrinsics_px": [1, 2]}, "a list of 4 numbers"),
        ({"targets_per_image": [-1, 1]}, "targets_per_image"),
        ({"width": 640.5}, "width=640.5; allowed: an integer from 8"),
        ({"window": [0, 64]}, r"window\[0\]=0; allowed: an integer from 8"),
        ({"depths": [2.0, 1.0]}, r"depths=\[2.0, 1.0\]; .* smallest <= largest"),
        ({"turning": {"kind": "moon"}}, "allowed: a mapping with kind: free, facing, upright"),
        ({"turning": "free"}, "turning='free'; allowed: a mapping"),
        ({"turning": {"kind": "upright", "up": "w"}}, "turning.up='w'; allowed: x, y, z"),
        ({"turning": {"kind": "facing", "roll": 3}}, "turning.roll=3; allowed: in_plane_deg"),
    ],
)
def test_wrong_changes_are_refused_in_one_line(changes, message):
    with pytest.raises(UserError, match=message) as caught:
        preset_of("paper", changes)
    assert "\n" not in str(caught.value)


def test_another_kind_starts_from_its_defaults():
    changed = preset_of("quickstart", {"turning": {"kind": "upright", "roll_deg": 5}})
    assert changed.turning == UprightTurning(roll_deg=5.0)
    kept = preset_of("quickstart", {"turning": {"tilt_deg": 5}}).turning
    assert kept == FacingTurning(in_plane_deg=45.0, tilt_deg=5.0)


def test_a_preset_file_changes_a_shipped_preset(tmp_path):
    path = tmp_path / "shelf.yaml"
    path.write_text("base: table\ntable: {roll_deg: 3.0}\nwidth: 320\n")
    preset = preset_of(str(path), {"width": 256})
    table = replace(PRESETS["table"].table, roll_deg=3.0)
    assert preset == replace(PRESETS["table"], name="shelf", width=256, table=table)
    base, changes = resolve_base(str(path), {"width": 256})
    assert (base, preset_of(base, changes)) == ("table", preset)
    for text in ("base: shelf", "- 1", "width: 64"):
        path.write_text(text)
        with pytest.raises(UserError, match=r"shelf.yaml with base=.*; allowed: bin, "):
            preset_of(str(path))
    path.write_text("base: paper\nwdith: 3")
    with pytest.raises(UserError, match="wdith=3; allowed: name, width"):
        preset_of(str(path))


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)


FIELDS = ("width", "table", "materials", "intrinsics_px", "targets_per_image", "placement", "name")


@given(st.sampled_from(FIELDS), PLAIN)
def test_any_plain_value_is_accepted_or_refused(field, value):
    try:
        preset = preset_of("paper", {field: value})
    except UserError:
        return
    assert type(preset) is type(PRESETS["paper"])


@pytest.mark.parametrize(("up", "axis"), [("x", 0), ("y", 1), ("z", 2)])
def test_upright_parts_stand_and_the_camera_looks_down(up, axis):
    turning = UprightTurning(up=up, elevation_deg=(20, 70), roll_deg=30)
    rng = np.random.default_rng(1)
    rotations = np.array([turning.draw(rng) for _ in range(2000)])
    assert all(is_rotation(rotation, 1e-9) for rotation in rotations)
    # Where the camera is, in the part's frame; its height above the horizon is the elevation.
    towards = -rotations[:, 2]
    height = np.degrees(np.arcsin(towards[:, axis]))
    assert kstest(height, "uniform", (20, 50)).pvalue > 1e-3
    around = np.arctan2(towards[:, axis - 1], towards[:, axis - 2])
    assert kstest(around, "uniform", (-np.pi, 2 * np.pi)).pvalue > 1e-3
    # The part's own vertical in the image, from straight up.
    vertical = rotations[:, :, axis]
    roll = np.degrees(np.arctan2(vertical[:, 0], -vertical[:, 1]))
    assert kstest(roll, "uniform", (-30, 60)).pvalue > 1e-3
