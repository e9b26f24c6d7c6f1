import cv2
import numpy as np
import pytest

from dopepp.data.rendered import FIRST_INDEX, MAX_ITEMS, RenderedSource
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS, preset_of


@pytest.fixture(scope="module")
def factory():
    return Factory([servoholder()], PRESETS["quickstart"], seed=3)


def test_sample_agrees_with_the_scene(factory):
    sample = RenderedSource(factory, 4).sample(2, epoch=1)
    rendered = factory.render(1, 2)
    np.testing.assert_array_equal(sample.image, rendered.image)
    (target,) = rendered.scene.targets
    (instance,) = sample.instances
    placed = rendered.scene.objects[target]
    expected, _ = cv2.projectPoints(
        servoholder().cuboid,
        cv2.Rodrigues(placed.T_cam_obj[:3, :3])[0],
        placed.T_cam_obj[:3, 3],
        sample.K,
        None,
    )
    np.testing.assert_allclose(instance.keypoints, expected[:, 0], atol=1e-6)
    assert instance.visible_fraction == rendered.visible_fractions[target]
    # The visible pixels lie inside the hull of the cuboid's corners.
    hull = cv2.convexHull(instance.keypoints[:8].astype(np.float32))
    rows, columns = np.nonzero(instance.mask)
    inside = [
        cv2.pointPolygonTest(hull, (float(u), float(v)), True)
        for u, v in zip(columns, rows, strict=True)
    ]
    assert min(inside) > -1.0
    assert (sample.source, sample.key) == ("virtual", "train/1/2")


def test_splits_are_disjoint_and_only_training_has_epochs(factory):
    sources = {split: RenderedSource(factory, 3, split) for split in FIRST_INDEX}
    images = {
        (split, epoch): source.sample(0, epoch).image
        for split, source in sources.items()
        for epoch in (0, 1)
    }
    assert (images["train", 0] != images["train", 1]).any()
    for split in ("val", "test"):
        np.testing.assert_array_equal(images[split, 0], images[split, 1])
        assert (images[split, 0] != images["train", 0]).any()
    assert (images["val", 0] != images["test", 0]).any()
    firsts = sorted(FIRST_INDEX.values())
    assert min(np.diff(firsts)) >= MAX_ITEMS


def test_bounds_description_and_objects(factory):
    source = RenderedSource(factory, 3)
    with pytest.raises(IndexError, match="index 3 is out of range"):
        source.sample(3)
    assert source.contains(servoholder().name)
    assert not source.contains(pivconnector().name)
    (info,) = source.describe()
    assert info.identity["parts"] == {servoholder().name: servoholder().mesh_hash}
    (other,) = RenderedSource(Factory(factory.parts, factory.preset, 4), 3).describe()
    assert other.identity != info.identity


def test_clutter_settings_belong_to_the_identity():
    def identity(**changes):
        factory = Factory([pivconnector()], preset_of("quickstart", changes), 3)
        (info,) = RenderedSource(factory, 4, "val").describe()
        return info.identity

    identities = identity(), identity(clutter=[0, 5]), identity(background_contrast=[0.5, 2.0])
    assert len({each["preset"] for each in identities}) == 3


def test_a_scale_moves_the_camera_of_the_same_test_set(factory):
    usual, near = (RenderedSource(factory, 2, "test", scale=scale) for scale in (1.0, 0.5))
    first, other = usual.sample(1), near.sample(1)
    assert first.key == other.key
    np.testing.assert_allclose(other.instances[0].keypoints[8], first.instances[0].keypoints[8])
    assert (first.image != other.image).any()
    ((described,), (there,)) = usual.describe(), near.describe()
    # Caches and checkpoints of the usual images stay valid.
    assert there.identity == {**described.identity, "scale": 0.5}
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="scale"):
            RenderedSource(factory, 2, scale=scale)
