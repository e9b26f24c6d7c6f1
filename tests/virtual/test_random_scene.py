"""Scenes at other scales, against projections and rigid motions in closed form."""

from functools import cache

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.geometry.camera import transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.virtual import Factory
from dopepp.virtual.factory import approach
from dopepp.virtual.presets import preset_of
from dopepp.virtual.scene import NEAR

NUM_SCENES = 6
SCALES = (0.5, 1.7)


class Waves:
    """An image so smooth that resampling it hardly changes a colour."""

    def identity(self):
        return ["waves"]

    def draw(self, rng, width, height):
        y, x = np.mgrid[:height, :width] / width
        channels = [np.sin(2 * x + 3 * y), np.cos(3 * x), np.sin(2 * y + rng.random())]
        return (127 + 120 * np.stack(channels, axis=-1)).astype(np.uint8)


PRESETS = {
    "wide": preset_of("wide", {}),
    "paper": preset_of("paper", {}).resized(160, 120),
    "table": preset_of("table", {}).resized(160, 120),
}


@cache
def factory(name):
    return Factory([servoholder(), pivconnector()], PRESETS[name], 1, Waves())


def scenes(name, scale):
    return [factory(name).scene(0, index, scale) for index in range(NUM_SCENES)]


def centre(item):
    return np.asarray(item.T_cam_obj @ [*item.part.cuboid[CENTROID], 1])[:3]


@pytest.mark.parametrize("scale", [0.25, *SCALES])
def test_a_scale_divides_the_distance_and_keeps_the_pixel(scale):
    for scene, near in zip(scenes("wide", 1), scenes("wide", scale), strict=True):
        (index,), (there,) = scene.targets, near.targets
        item = scene.objects[index]
        turned = (item.part.cuboid - item.part.cuboid[CENTROID]) @ item.T_cam_obj[:3, :3].T
        pixels = (turned + centre(item) / scale) @ scene.K.T
        np.testing.assert_allclose(near.keypoints(there), pixels[:, :2] / pixels[:, 2:])
        same_place = scene.keypoints(index)[CENTROID]
        np.testing.assert_allclose(near.keypoints(there)[CENTROID], same_place)


@pytest.mark.parametrize("name", ["wide", "table"])
@pytest.mark.parametrize("scale", SCALES)
def test_only_the_camera_moves(name, scale):
    for scene, near in zip(scenes(name, 1), scenes(name, scale), strict=True):
        first, second = (
            np.mean([centre(s.objects[i]) for i in s.targets], axis=0) for s in (scene, near)
        )
        np.testing.assert_allclose(second, first / scale)
        shift = second - first
        depths = [transform(item.T_cam_obj, item.surface.hull)[:, 2] for item in scene.objects]
        kept = [item for item, z in zip(scene.objects, depths, strict=True)
                if (z + shift[2]).min() > NEAR]  # fmt: skip
        for item, other in zip(kept, near.objects, strict=True):
            np.testing.assert_array_equal(other.surface.hull, item.surface.hull)
            assert other.material == item.material
            np.testing.assert_array_equal(other.T_cam_obj[:3, :3], item.T_cam_obj[:3, :3])
            np.testing.assert_allclose(other.T_cam_obj[:3, 3], item.T_cam_obj[:3, 3] + shift)
        for first, other in zip(scene.lights, near.lights, strict=True):
            np.testing.assert_allclose(other.position, first.position + shift)
            assert (first.intensity, first.reach) == (other.intensity, other.reach)
        assert (scene.ambient, scene.sensor) == (near.ambient, near.sensor)
        if scene.plane is None:
            np.testing.assert_array_equal(scene.background, near.background)
        else:
            assert near.plane.normal == scene.plane.normal
            offset = scene.plane.offset + scene.plane.normal @ shift
            assert near.plane.offset == pytest.approx(offset)


@pytest.mark.parametrize("scale", SCALES)
def test_the_image_on_a_table_does_not_move(scale):
    rng, differences = np.random.default_rng(0), []
    for scene, near in zip(scenes("table", 1), scenes("table", scale), strict=True):
        pixels = np.rint(rng.uniform(0, 1, (200, 2)) * (np.array(scene.size) - 1)).astype(int)
        rays = np.c_[pixels, np.ones(200)] @ np.linalg.inv(scene.K).T
        points = rays * (scene.plane.offset / (rays @ scene.plane.normal))[:, None]
        shift = centre(near.objects[0]) - centre(scene.objects[0])
        seen = (points + shift) @ scene.K.T
        moved = np.rint(seen[:, :2] / seen[:, 2:]).astype(int)
        inside = ((moved >= 0) & (moved < scene.size)).all(axis=1) & (seen[:, 2] > 0)
        colours = scene.background[tuple(pixels[inside, ::-1].T)].astype(int)
        others = near.background[tuple(moved[inside, ::-1].T)].astype(int)
        differences += np.abs(colours - others).max(axis=1).tolist()
    assert len(differences) > 200
    # Half a pixel of a smooth image; more only at the few points that are seen at a flat angle.
    assert np.quantile(differences, 0.95) <= 6


class Plain:
    """Images of one random grey."""

    def draw(self, rng, width, height):
        return np.full((height, width, 3), rng.integers(256), np.uint8)


def end_of_table(scene):
    """Least and largest depth at which the table may end, behind the first target, metres."""
    column = scene.background[:, 80, 0]
    first = int(np.flatnonzero(column == column[-1])[0])  # row of the table
    row = scene.plane.inverse_depth_row(scene.K)
    near, far = (1 / max(row @ [80, v, 1], 1e-9) for v in (first, first - 1))
    return near - centre(scene.objects[0])[2], far - centre(scene.objects[0])[2]


@pytest.mark.parametrize("scale", [0.05, 0.5, 4.0])
def test_the_end_of_a_table_does_not_move(scale):
    preset = preset_of("table", {"table": {"elevation_deg": [10.0, 12.0], "roll_deg": 0.0}})
    flat = Factory([servoholder()], preset.resized(160, 120), 1, Plain())
    for index in range(3):
        ends = [end_of_table(flat.scene(0, index, level)) for level in (1.0, scale)]
        (near, other_near), (far, other_far) = zip(*ends, strict=True)
        assert max(near, other_near) <= min(far, other_far)


def test_without_a_part_the_camera_stays():
    objects = (item for scene in scenes("wide", 1) for item in scene.objects)
    distractors = [item for item in objects if not item.is_target]
    assert distractors
    np.testing.assert_array_equal(approach(distractors, 3.0), np.zeros(3))


def test_objects_that_the_camera_has_passed_are_removed():
    assert len(factory("paper").scene(0, 0).targets) == 1
    rendered = factory("paper").render(0, 0, 15.0)
    assert rendered.scene.objects == ()
    assert (rendered.instances == -1).all()


def test_a_camera_stays_above_the_table(sized_box):
    low = {"distance": [0.3, 0.3], "elevation_deg": [10.0, 10.0]}
    preset = preset_of("table", {"table": low, "min_visible_fraction": 0.1})
    factory = Factory([sized_box("high", 8.0)], preset, 0)
    factory.scene(0, 0)
    with pytest.raises(UserError, match=r"scale 0\.25 of a scene .*set a larger scale"):
        factory.scene(0, 0, 0.25)
