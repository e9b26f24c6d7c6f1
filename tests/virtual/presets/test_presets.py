"""Presets: their ranges hold over many random scenes, and their cameras follow the image size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from dopepp.core.errors import UserError
from dopepp.geometry.camera import project, resize_camera, transform
from dopepp.geometry.rotation import random_rotation
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import Part, make_part
from dopepp.virtual import (
    PRESETS,
    DistancePlacement,
    FacingTurning,
    Factory,
    FillPlacement,
    OffsetPlacement,
    Scene,
)
from dopepp.virtual.presets.preset import Distractors, Preset

NUM_SCENES = 200


def scenes(preset: Preset, parts: list[Part]) -> list[Scene]:
    small = preset.resized(max(preset.width // 8, 32), max(preset.height // 8, 24))
    factory = Factory(parts, small, seed=5)
    return [factory.scene(0, index) for index in range(NUM_SCENES)]


@pytest.fixture(scope="module")
def parts() -> list[Part]:
    return [servoholder(), pivconnector()]


@pytest.fixture(scope="module")
def quickstart_scenes(parts: list[Part]) -> list[Scene]:
    factory = Factory(parts, PRESETS["quickstart"], seed=5)
    return [factory.scene(0, index) for index in range(NUM_SCENES)]


def angles(rotation: np.ndarray) -> tuple[float, float]:
    """(in-plane, tilt) in degrees, from the rotation alone.

    The tilt rotates about an axis in the image plane, so the twist about the optical axis of
    R·FACINGᵀ is the in-plane angle (swing-twist decomposition).
    """
    tilt = np.degrees(np.arccos(np.clip(-rotation[2, 2], -1, 1)))
    swing = rotation @ np.diag([1.0, -1.0, -1.0])
    in_plane = np.degrees(np.arctan2(swing[1, 0] - swing[0, 1], swing[0, 0] + swing[1, 1]))
    return float(in_plane), float(tilt)


def test_quickstart_poses(quickstart_scenes: list[Scene]) -> None:
    measured = np.array([angles(s.objects[0].T_cam_obj[:3, :3]) for s in quickstart_scenes])
    assert np.abs(measured[:, 0]).max() <= 45 + 1e-6
    assert measured[:, 1].max() <= 40 + 1e-6
    assert np.abs(measured[:, 0]).max() > 42
    assert measured[:, 1].max() > 37
    assert {s.objects[0].label for s in quickstart_scenes} == {"servoholder", "pivconnector"}
    assert {len(s.objects) for s in quickstart_scenes} == {1, 2, 3}
    assert all(s.plane is None for s in quickstart_scenes)


def test_quickstart_fill(quickstart_scenes: list[Scene]) -> None:
    shares = []
    for scene in quickstart_scenes:
        item = scene.objects[0]
        pixels = project(transform(item.T_cam_obj, item.surface.vertices), scene.K)
        shares.append(np.ptp(pixels, axis=0).max() / 128)
        assert pixels.min() > -1
        assert pixels.max() < 128
    assert min(shares) > 0.60 - 0.003
    assert max(shares) < 0.95 + 0.003
    assert max(shares) - min(shares) > 0.3


def test_targets_stay_visible(parts: list[Part]) -> None:
    preset = replace(PRESETS["quickstart"], distractors=Distractors((3, 5), (0.3, 0.7), (0.5, 0.9)))
    factory = Factory(parts, preset, seed=1)
    fractions = np.array([factory.render(0, i).visible_fractions[0] for i in range(60)])
    assert fractions.min() >= preset.min_visible_fraction
    assert (fractions < 0.95).any()


def test_paper_poses(parts: list[Part]) -> None:
    drawn = scenes(PRESETS["paper"], parts)
    offsets = np.array([s.objects[0].T_cam_obj[:3, 3] for s in drawn])
    assert np.abs(offsets[:, :2]).max() <= 0.15
    assert offsets[:, 2].min() >= 0.10
    assert offsets[:, 2].max() <= 0.30
    assert offsets[:, 2].max() - offsets[:, 2].min() > 0.17
    assert {len(s.objects) for s in drawn} == {1}
    tilts = np.array([angles(s.objects[0].T_cam_obj[:3, :3])[1] for s in drawn])
    assert tilts.min() < 30
    assert tilts.max() > 150


def test_what_the_camera_does_not_see_of_the_papers_box_skews_no_place_across_nor_rotation(
    parts: list[Part],
) -> None:
    preset = PRESETS["paper"]
    factory = Factory(parts, preset.resized(80, 60), seed=90125)
    T = np.array([factory.scene(0, index).objects[0].T_cam_obj for index in range(600)])
    x, y, z = T[:, :3, 3].T
    for aside in (x, y):
        assert kstest(np.abs(aside) / 0.15, "uniform").pvalue > 0.05
        assert np.abs(aside).mean() == pytest.approx(0.075, abs=0.003)
    # A sphere's area is uniform over its height.
    assert kstest((T[:, 2, 2] + 1) / 2, "uniform").pvalue > 0.05
    # At 90° the picture shows the box's whole width where y is small and z large: no skew there.
    whole = (np.abs(y) < 0.05) & (np.abs(x) < 0.05)
    assert z[whole].mean() == pytest.approx(0.2, abs=0.02)
    assert z.mean() == pytest.approx(0.219, abs=0.005)


def test_a_place_that_no_depth_suits_is_given_up(box_part: Part) -> None:
    assert box_part.mesh is not None
    large = make_part("large", replace(box_part.mesh, vertices=box_part.mesh.vertices * 3))
    preset = replace(PRESETS["paper"].resized(80, 60), placement=OffsetPlacement(lateral=0.25))
    factory = Factory([large], preset, seed=0)
    places = np.array([factory.scene(0, n).objects[0].T_cam_obj[:3, 3] for n in range(20)])
    assert (
        np.abs(places[:, 1]) < 0.225
    ).all()  # of the drawn ones, a tenth is never in the picture


def test_ycb_distances(box_part: Part) -> None:
    drawn = scenes(PRESETS["ycb"], [box_part])
    depths = np.array([s.objects[0].T_cam_obj[2, 3] for s in drawn])
    assert depths.min() >= 0.5
    assert depths.max() <= 1.2


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_centroids_lie_inside_and_in_front(name: str, box_part: Part) -> None:
    for scene in scenes(PRESETS[name], [box_part]):
        width, height = scene.size
        for index in scene.targets:
            u, v = scene.keypoints(index)[8]
            assert -0.5 <= u < width - 0.5
            assert -0.5 <= v < height - 0.5
            corners = transform(scene.objects[index].T_cam_obj, scene.objects[index].surface.hull)
            assert corners[:, 2].min() > 0.01


def test_light_ranges(quickstart_scenes: list[Scene]) -> None:
    ranges = PRESETS["quickstart"].lighting
    for scene in quickstart_scenes:
        assert ranges.num_lights[0] <= len(scene.lights) <= ranges.num_lights[1]
        for number, light in enumerate(scene.lights):
            low, high = ranges.fill_intensity if number else ranges.key_intensity
            luminance = np.array(light.intensity) @ [0.2126, 0.7152, 0.0722]
            assert low * (1 - ranges.tint) <= luminance <= high * (1 + ranges.tint)
            assert light.reach > 0


@pytest.mark.parametrize("size", [(416, 416), (416, 312), (128, 128)])
def test_resized_follows_the_resize_rule(size: tuple[int, int]) -> None:
    for preset in PRESETS.values():
        resized = preset.resized(*size)
        expected = resize_camera(preset.K, size[0] / preset.width, size[1] / preset.height)
        np.testing.assert_allclose(resized.K, expected)
        assert (resized.width, resized.height) == size


def test_resized_draws_the_same_poses(box_part: Part) -> None:
    preset = replace(PRESETS["ycb"], distractors=Distractors((0, 0)), min_visible_fraction=0.0)
    factories = [Factory([box_part], p, 3) for p in (preset, preset.resized(320, 240))]
    for index in range(5):
        large, small = (factory.scene(0, index).objects[0] for factory in factories)
        np.testing.assert_allclose(large.T_cam_obj, small.T_cam_obj, atol=1e-9)


def test_field_of_view_follows_the_width() -> None:
    wide = replace(PRESETS["paper"], width=320, height=240)
    assert wide.K[0, 0] == pytest.approx(160.0)
    np.testing.assert_allclose(wide.K[:2, 2], [159.5, 119.5])
    assert PRESETS["paper"].K[0, 0] == pytest.approx(320.0)


@settings(deadline=None, max_examples=50)
@given(
    seed=st.integers(0, 10_000),
    share=st.floats(0.1, 1.0),
    width=st.integers(16, 800),
    height=st.integers(16, 800),
    focal=st.floats(0.3, 4.0),
)
def test_fill_placement_reaches_its_share(
    seed: int, share: float, width: int, height: int, focal: float
) -> None:
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
        ({"targets_per_image": (-1, 1)}, "targets_per_image"),
        ({"targets_per_image": (0.0, 1.0)}, "two whole numbers"),
        ({"width": 4}, "width=4 of quickstart; allowed: a number from 8"),
        ({"width": True}, "width=True of quickstart"),
        ({"min_visible_fraction": 1.0}, r"a number from 0 to 0.95"),
        ({"min_visible_fraction": float("nan")}, "min_visible_fraction=nan"),
        ({"horizontal_fov_deg": 179.0}, r"from 5 to 150 \(degrees\)"),
        ({"intrinsics_px": (300.0, 300.0)}, "four numbers"),
        ({"intrinsics_px": (300.0, 300.0, 900.0, 20.0)}, "principal point inside"),
    ],
)
def test_wrong_presets_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        replace(PRESETS["quickstart"], **change)


@pytest.mark.parametrize(
    "make",
    [
        lambda: FillPlacement(0.9, 0.6),
        lambda: FillPlacement(0.0, 0.6),
        lambda: DistancePlacement(1.0, 0.5),
        lambda: DistancePlacement(margin=0.6),
        lambda: DistancePlacement(nearest=float("nan")),
        lambda: OffsetPlacement(distance=0.1, axial=0.1),
        lambda: OffsetPlacement(distance=float("inf")),
        lambda: FillPlacement(smallest=True),
        lambda: FacingTurning(tilt_deg=-1),
    ],
)
def test_wrong_ranges_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(UserError, match="allowed"):
        make()


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_stated_visibility_holds(name: str, parts: list[Part]) -> None:
    preset = replace(PRESETS[name].resized(320, 240), distractors=Distractors((0, 8)))
    factory = Factory(parts, preset, seed=3)
    for index in range(10):
        rendered = factory.render(0, index)
        fractions = rendered.visible_fractions[list(rendered.scene.targets)]
        assert (fractions >= preset.min_visible_fraction).all()


def test_zero_to_one_target_gives_both(parts: list[Part]) -> None:
    preset = replace(PRESETS["paper"].resized(80, 60), targets_per_image=(0, 1))
    factory = Factory(parts, preset, seed=0)
    counts = [len(factory.scene(0, index).targets) for index in range(40)]
    assert set(counts) == {0, 1}


def test_a_resized_preset_blurs_in_proportion() -> None:
    preset = PRESETS["paper"]
    small = preset.resized(320, 240)
    assert small.sensors.blur_px == tuple(value / 2 for value in preset.sensors.blur_px)
    assert small.sensors.read_noise == preset.sensors.read_noise


def test_a_part_that_cannot_be_shown_is_an_error(box_part: Part) -> None:
    assert box_part.mesh is not None
    huge = make_part("huge", replace(box_part.mesh, vertices=box_part.mesh.vertices * 40))
    with pytest.raises(UserError, match="part huge of diameter 4"):
        Factory([huge], PRESETS["paper"], 0).scene(0, 0)


def test_several_targets_do_not_pierce_each_other(parts: list[Part]) -> None:
    preset = replace(
        PRESETS["paper"], targets_per_image=(2, 3), min_visible_fraction=0.2,
        placement=DistancePlacement(0.2, 0.5),
    )  # fmt: skip
    factory = Factory(parts, preset.resized(160, 120), seed=2)
    rendered = [factory.render(0, index) for index in range(20)]
    assert {len(r.scene.targets) for r in rendered} >= {2, 3}
    for r in rendered:
        assert (r.visible_fractions[list(r.scene.targets)] >= 0.2).all()
