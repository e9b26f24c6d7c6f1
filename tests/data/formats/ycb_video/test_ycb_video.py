import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
import trimesh

from dopepp.core.errors import UserError
from dopepp.data.formats.ycb_video import read_meta
from dopepp.data.formats.ycb_video.ycb_reader import YcbVideoReader
from dopepp.data.sample import hull_areas
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import ProceduralBackgrounds


def ycb_part_of(root: Path, name: str) -> Part:
    points = np.loadtxt(root / "models" / name / "points.xyz")
    cuboid = cuboid_keypoints(points.min(axis=0), points.max(axis=0))
    return Part(name, cuboid, float(np.ptp(points, axis=0).max()), points)


def source_of(tree: Any, box: Part, **options: Any) -> YcbVideoReader:
    return YcbVideoReader(tree.root, [box], **({"image_set": ["0000/000001"]} | options))


SYNTHETIC = {"image_set": ["000000"], "subset": "synthetic", "backgrounds": ProceduralBackgrounds()}


def test_reads_pose_camera_depth_and_mask(ycb_tree, box):
    def stored(what):
        return cv2.imread(str(ycb_tree.path("0000/000001", what)), cv2.IMREAD_UNCHANGED)

    poses = ycb_tree.write("0000/000001", classes=(1, 2))
    sample = source_of(ycb_tree, box).sample(0)
    (instance,) = sample.instances
    names = (instance.label, sample.source, sample.key)
    assert names == ("003_box", "ycb_video/data", "0000/000001")
    np.testing.assert_array_equal(instance.T_cam_obj[:3], poses[..., 1])
    expected, _ = cv2.projectPoints(box.cuboid, np.zeros(3), poses[:, 3, 1], ycb_tree.K, None)
    np.testing.assert_allclose(instance.keypoints, expected[:, 0], atol=1e-9)
    np.testing.assert_array_equal(sample.K, ycb_tree.K)
    np.testing.assert_allclose(sample.depth, 0.3, rtol=1e-6)
    np.testing.assert_array_equal(instance.mask, stored("label.png") == 2)
    np.testing.assert_array_equal(sample.image, stored("color.png")[..., ::-1])
    assert source_of(ycb_tree, box, read_depth=False).sample(0).depth is None


@pytest.mark.parametrize(("scene", "fx"), [("0059", 1066.778), ("0060", 1077.836)])
def test_the_scene_determines_a_missing_camera(ycb_tree, box, scene, fx):
    frame = f"{scene}/000001"
    ycb_tree.write(frame, intrinsic_matrix=None)
    image = np.zeros((480, 640, 3), np.uint8)
    for what, array in (("color", image), ("label", image[..., 0]), ("depth", image[..., 0])):
        cv2.imwrite(str(ycb_tree.path(frame, f"{what}.png")), array)
    assert source_of(ycb_tree, box, image_set=[frame]).sample(0).K[0, 0] == fx


def test_visible_fraction_of_a_half_hidden_object(ycb_tree, box):
    ycb_tree.write("0000/000001")
    whole = source_of(ycb_tree, box).sample(0).instances[0]
    assert whole.visible_fraction > 0.95
    label = np.where(whole.mask, 2, 0).astype(np.uint8)
    columns = np.flatnonzero(whole.mask.any(axis=0))
    label[:, columns[len(columns) // 2] :] = 0
    cv2.imwrite(str(ycb_tree.path("0000/000001", "label.png")), label)
    half = source_of(ycb_tree, box).sample(0).instances[0]
    assert half.visible_fraction == pytest.approx(0.5 * whole.visible_fraction, abs=0.05)


def test_unlabelled_real_object_counts_the_border_only(ycb_tree, box):
    poses = ycb_tree.write("0000/000001", labelled=False)
    poses[0, 3] = 0.47 * 0.3  # centred on the last column: half of it lies outside
    ycb_tree.write("0000/000001", labelled=False, poses=poses)
    instance = source_of(ycb_tree, box).sample(0).instances[0]
    assert instance.mask is None
    assert instance.visible_fraction == pytest.approx(0.5, abs=0.08)


def test_synthetic_frames_are_composited_deterministically(ycb_tree, box):
    ycb_tree.write("data_syn/000000")
    source = source_of(ycb_tree, box, **SYNTHETIC)
    first, again, later = source.sample(0, 0), source.sample(0, 0), source.sample(0, 1)
    assert first.source == "ycb_video/data_syn"
    np.testing.assert_array_equal(first.image, again.image)
    mask = first.instances[0].mask
    np.testing.assert_array_equal(first.image[mask], later.image[mask])
    assert (first.image[~mask] != later.image[~mask]).mean() > 0.5
    other_seed = source_of(ycb_tree, box, **SYNTHETIC, seed=1).sample(0, 0)
    assert (first.image != other_seed.image).any()


def test_hidden_synthetic_object_has_fraction_zero(ycb_tree, box):
    ycb_tree.write("data_syn/000000", labelled=False)
    instance = source_of(ycb_tree, box, **SYNTHETIC).sample(0).instances[0]
    assert instance.visible_fraction == 0.0
    assert not instance.mask.any()


def test_describe_and_contains(ycb_tree, box):
    for frame, number in (("0000/000001", 2), ("0000/000002", 1)):
        ycb_tree.write(frame, classes=(number,))
    parts, frames = [box, replace(box, name="004_mug")], ["0000/000002", "0000/000001"]
    source = YcbVideoReader(ycb_tree.root, parts, frames)
    contained = [source.contains(name) for name in ("003_box", "004_mug", "no_such")]
    assert contained == [True, False, False]
    (info,) = source.describe()
    assert (info.num_images, info.num_instances) == (2, {"003_box": 1, "004_mug": 0})
    (other,) = YcbVideoReader(ycb_tree.root, parts, frames[1:]).describe()
    assert info.identity != other.identity


def test_hull_areas_against_trimesh_and_shapes():
    square = np.array([[-0.5, -0.5], [9.5, -0.5], [9.5, 9.5], [-0.5, 9.5], [4.0, 4.0]])
    for shift, area in (([0, 0], 100.0), ([95, 0], 50.0), ([500, 500], 0.0)):
        assert hull_areas(square + np.array(shift), (100, 100)) == pytest.approx((area, 100.0))
    assert hull_areas(np.full((5, 2), np.nan), (100, 100)) == (0.0, 0.0)
    cloud = np.random.default_rng(0).normal(50, 5, (200, 2))
    prism = np.vstack([np.c_[cloud, np.zeros(200)], np.c_[cloud, np.ones(200)]])
    volume = trimesh.convex.convex_hull(prism).volume
    assert hull_areas(cloud, (100, 100))[1] == pytest.approx(volume, rel=1e-4)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"root": "nowhere"}, r"nowhere, which has no data/.*set data\.root"),
    ({"root": "empty"}, r"empty, which has no data/.*a YCB-Video folder"),
    ({"root": "bare"}, r"no image_sets/classes\.txt"),
    ({"part": "servoholder"}, r"'servoholder'.*002_can.*003_box.*004_mug"),
    ({"image_set": "trian"}, r"image set 'trian'; allowed: one of \['odd', 'train'\]"),
    ({"image_set": "odd"}, r"odd\.txt: line 'colour\.png'"),
    ({}, r"no frame of train\.txt.*2 listed.*at least one"),
], ids=str)  # fmt: skip
def test_wrong_roots_and_unknown_names_are_rejected(arguments, message, tmp_path, ycb_tree, box):
    ycb_tree.write_list("train", ["0007/000001", "0007/000002"])
    ycb_tree.write_list("odd", ["colour.png"])
    (tmp_path / "empty").mkdir()
    shutil.copytree(ycb_tree.root, tmp_path / "bare")
    (tmp_path / "bare" / "image_sets" / "classes.txt").unlink()
    given = {"root": "ycb", "part": "003_box", "image_set": "train"} | arguments
    part = replace(box, name=given["part"])
    with pytest.raises(UserError, match=message):
        YcbVideoReader(tmp_path / given["root"], [part], given["image_set"])


@pytest.mark.parametrize(
    ("frame", "name"),
    [
        ("0000/000001", "009_gelatin_box"),
        ("0050/000003", "003_cracker_box"),
        ("0050/000003", "006_mustard_bottle"),
        ("0051/000001", "005_tomato_soup_can"),
    ],
)
def test_projected_cuboid_covers_the_real_label_at_its_depth(ycb_root, frame, name):
    part = ycb_part_of(ycb_root, name)
    sample = YcbVideoReader(ycb_root, [part], [frame]).sample(0)
    (instance,) = sample.instances
    hull = cv2.convexHull(instance.keypoints[:8].astype(np.float32))
    rows, columns = np.nonzero(instance.mask)
    distances = [
        cv2.pointPolygonTest(hull, (float(u), float(v)), True)
        for u, v in zip(columns[::17], rows[::17], strict=True)
    ]
    assert min(distances) > -8  # the released poses sit 2–6 px off the image
    assert 0.1 < instance.visible_fraction <= 1
    measured = sample.depth[instance.mask & (sample.depth > 0)]
    assert abs(np.median(measured) - instance.T_cam_obj[2, 3]) < part.diameter / 2


def test_real_synthetic_frame_and_lists(ycb_root, caplog):
    names = ("003_cracker_box", "005_tomato_soup_can")
    parts = [ycb_part_of(ycb_root, name) for name in names]
    assert YcbVideoReader(ycb_root, parts, "train").frames == ["0000/000001", "0050/000003"]
    with caplog.at_level(logging.WARNING):
        test = YcbVideoReader(ycb_root, parts, "keyframe")
    assert "2,949 frames listed in keyframe.txt are absent" in caplog.text
    assert 1 <= len(test) <= 3
    backgrounds = ProceduralBackgrounds()
    synthetic = YcbVideoReader(ycb_root, parts, "train", "synthetic", backgrounds=backgrounds)
    sample = synthetic.sample(0)
    assert {instance.label for instance in sample.instances} <= set(names)
    assert sample.image.std() > 5


def test_a_field_that_unpacks_to_much_memory_is_rejected(tmp_path):
    path = tmp_path / "000001-meta.mat"
    fields = {"poses": np.zeros((3, 4, 20_000)), "cls_indexes": [1.0], "factor_depth": 1e4}
    scipy.io.savemat(path, {**fields, "vertmap": np.zeros((480, 640, 3))}, do_compression=True)
    assert path.stat().st_size < 100_000
    with pytest.raises(UserError, match="a field of over 1 MB"):
        read_meta(path)
    fields["poses"] = np.eye(4)[:3, :, None]
    fields["poses"][2, 3] = 1
    scipy.io.savemat(path, {**fields, "vertmap": np.zeros((480, 640, 3))}, do_compression=True)
    assert list(read_meta(path).poses) == [1]
