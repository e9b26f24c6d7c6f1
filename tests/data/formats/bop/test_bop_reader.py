import io
import json
import pickle
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.core.files import encode_image
from dopepp.data.check import check_dataset
from dopepp.data.formats import share_slice
from dopepp.data.formats.bop.bop_models import bop_parts
from dopepp.data.formats.bop.bop_reader import BopReader
from dopepp.data.formats.images import decode_mask, decode_rgb
from tests.data.makers import block

K = [100.0, 0.0, 31.5, 0.0, 101.0, 23.5, 0.0, 0.0, 1.0]
R = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
"""Rotation, row by row: x_cam = −y_obj, y_cam = x_obj."""
TARGETS = "test_targets_bop19.json"


def truth(number: int, t: tuple[float, float, float] = (5.0, -10.0, 250.0)) -> dict[str, Any]:
    return {"cam_R_m2c": list(R), "cam_t_m2c": list(t), "obj_id": number}


class Scene:
    """Writes a scene from literal numbers, without dopepp's writer."""

    def __init__(self, root: Path, split: str = "test", number: int = 1) -> None:
        self.root, self.folder = root, root / split / f"{number:06d}"
        self.folder.mkdir(parents=True)

    def annotate(self, truths: dict[str, Any], fractions: dict[str, list[float]] | None) -> None:
        self.json("scene_camera", {key: {"cam_K": K, "depth_scale": 0.5} for key in truths})
        self.json("scene_gt", truths)
        if fractions is not None:
            infos = {k: [{"visib_fract": f} for f in row] for k, row in fractions.items()}
            self.json("scene_gt_info", infos)

    def json(self, name: str, value: object) -> None:
        (self.folder / f"{name}.json").write_text(json.dumps(value))

    def image(self, name: str, pixels: np.ndarray) -> None:
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        if pixels.ndim == 3:
            pixels = pixels[..., ::-1]
        assert cv2.imwrite(str(path), pixels)


@pytest.fixture
def scene(tmp_path):
    """Two images, with two blocks on the first."""
    made = Scene(tmp_path)
    made.annotate({"3": [truth(9), truth(2)], "11": []}, {"3": [0.25, 0.75], "11": []})
    for stem in ("000003", "000011"):
        made.image(f"rgb/{stem}.png", np.full((48, 64, 3), (200, 0, 0), np.uint8))
        made.image(f"depth/{stem}.png", np.full((48, 64), 500, np.uint16))
    mask = np.zeros((48, 64), np.uint8)
    mask[10:20, 30:40] = 255
    made.image("mask_visib/000003_000001.png", mask)
    return made


@pytest.fixture
def open_test(scene):
    """Read the scene as a data set of one part."""
    return partial(BopReader, scene.root, [block(2)], "test")


def test_conventions_in_literal_numbers(open_test):
    source = open_test()
    assert len(source) == 2
    sample = source.sample(0)
    (instance,) = sample.instances
    expected = np.array([[0, -1, 0, 0.005], [1, 0, 0, -0.010], [0, 0, 1, 0.250], [0, 0, 0, 1]])
    np.testing.assert_allclose(instance.T_cam_obj, expected, atol=1e-15)
    np.testing.assert_array_equal(sample.K, np.reshape(K, (3, 3)))
    # The centre projects to fx·x/z + cx = 100·5/250 + 31.5 and 101·(−10)/250 + 23.5.
    np.testing.assert_allclose(instance.keypoints[8], [33.5, 19.46], atol=1e-12)
    turn = Rotation.from_matrix(np.reshape(R, (3, 3))).as_rotvec()
    place = np.array([5.0, -10.0, 250.0])
    projected, _ = cv2.projectPoints(1000 * block(2).cuboid, turn, place, sample.K, None)
    np.testing.assert_allclose(instance.keypoints, projected[:, 0], atol=1e-9)
    assert (instance.visible_fraction, instance.mask.sum()) == (0.75, 100)
    assert instance.mask[10, 30]
    np.testing.assert_allclose(sample.depth, 0.25)  # 500 units of 0.5 mm
    assert (sample.image[..., 0] == 200).all()  # red
    assert (sample.source, sample.key) == ("bop/test", "000001/000003")
    assert sample.image.flags.writeable
    assert instance.T_cam_obj.flags.writeable
    empty = source.sample(1)
    assert (empty.instances, empty.key) == ([], "000001/000011")
    contained = [source.contains(name) for name in ("obj_000002", "obj_000009")]
    assert contained == [True, False]
    (info,) = source.describe()
    assert info.num_instances == {"obj_000002": 1}
    assert info.identity["left_out"] == {"other_objects": 1, "behind_the_camera": 0}
    copied = pickle.loads(pickle.dumps(source)).sample(0)
    np.testing.assert_array_equal(copied.image, sample.image)
    assert open_test(read_depth=False).sample(0).depth is None


def test_gray_tiff_jpeg_and_16_bit_tiff_depth(tmp_path):
    scene = Scene(tmp_path, "val", 7)
    scene.annotate({"0": [truth(1)], "1": [truth(1)]}, None)
    grey = np.tile(np.arange(64, dtype=np.uint8), (48, 1))
    scene.image("gray/000000.tif", grey)
    Image.fromarray(grey).save(scene.folder / "gray" / "000001.jpg", quality=95)
    depth = np.full((48, 64), 40_000, np.uint16)
    depth[0, 0] = 0
    scene.image("depth/000000.tif", depth)
    scene.image("depth/000001.png", depth)
    source = BopReader(tmp_path, [block(1)], "val")
    for index in (0, 1):
        sample = source.sample(index)
        assert np.abs(sample.image - grey[..., None].astype(int)).max() <= 3 * index
        np.testing.assert_allclose(sample.depth, depth * 0.0005, rtol=1e-6)
        assert sample.instances[0].mask is None


def test_a_missing_visible_fraction_is_estimated(tmp_path):
    scene = Scene(tmp_path)
    half_out = truth(1, (-78.75, 0.0, 250.0))  # its centre is on the left border, pixel −½ + ½
    scene.annotate({"0": [truth(1), half_out]}, None)
    scene.image("rgb/000000.png", np.zeros((48, 64, 3), np.uint8))
    mask = np.zeros((48, 64), np.uint8)
    mask[15:20, 30:35] = 1
    scene.image("mask_visib/000000_000000.png", mask)
    source = BopReader(tmp_path, [block(1)], "test")
    masked, bare = source.sample(0).instances
    hull = cv2.contourArea(cv2.convexHull(masked.keypoints[:8].astype(np.float32)))
    assert masked.visible_fraction == pytest.approx(25 / hull)
    assert bare.visible_fraction == pytest.approx(0.5, abs=0.06)
    assert "estimated" in str(source.describe()[0].identity["visible_fractions"])


def test_scenes_images_targets_and_shares(tmp_path):
    for number in (2, 10):
        scene = Scene(tmp_path, "train_pbr", number)
        scene.annotate({str(i): [truth(1)] for i in (0, 2, 10, 1)}, None)
        for i in (0, 1, 2, 10):
            scene.image(f"rgb/{i:06d}.jpg", np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "train_pbr" / "notes").mkdir()

    def keys(**options):
        source = BopReader(tmp_path, [block(1)], "train_pbr", **options)
        return [source.sample(i).key for i in range(len(source))]

    everything = keys()
    assert everything == [f"{s:06d}/{i:06d}" for s in (2, 10) for i in (0, 1, 2, 10)]
    assert keys(part_of=(0, 0.8)) + keys(part_of=(0.8, 0.9)) + keys(part_of=(0.9, 1)) == everything
    targets = [{"scene_id": 10, "im_id": i, "obj_id": 1, "inst_count": 1} for i in (10, 0, 0)]
    (tmp_path / TARGETS).write_text(json.dumps(targets))
    assert keys(targets=TARGETS) == ["000010/000000", "000010/000010"]
    with pytest.raises(UserError, match=r"no image in the fraction 0 – 0\.01 of 8 images"):
        keys(part_of=(0, 0.01))
    (tmp_path / TARGETS).write_text('[{"scene_id": "1", "im_id": 3}]')
    with pytest.raises(UserError, match=r"bop19\.json\[0\]\.scene_id=.1."):
        keys(targets=TARGETS)


@given(st.integers(1, 200), st.lists(st.floats(0.01, 0.99), max_size=4, unique=True))
def test_shares_are_disjoint_and_complete(num_items, inner):
    bounds = [0.0, *sorted(inner), 1.0]
    taken = []
    for first, last in pairwise(bounds):
        try:
            taken += range(num_items)[share_slice(num_items, (first, last), "x")]
        except UserError:
            continue
    assert taken == list(range(num_items))


def test_absent_images_and_objects_behind_the_camera_are_counted(scene, open_test, caplog):
    caplog.set_level("INFO")
    (scene.folder / "rgb" / "000011.png").unlink()
    scene.json("scene_gt", {"3": [truth(2, (0, 0, -50.0)), truth(2)], "99": [truth(2)]})
    scene.json("scene_gt_info", {"3": [{"visib_fract": 0.0}] * 2, "99": [{"visib_fract": 1}]})
    source = open_test()
    assert [len(source.sample(i).instances) for i in range(len(source))] == [1]
    assert source.sample(0).instances[0].mask is not None  # number 1 of the list
    assert "1 of 2 listed images are absent" in caplog.text
    assert "ignoring 1 images with ground truth but without a camera" in caplog.text
    assert "0 objects that are not among the parts and 1 behind the camera" in caplog.text


def bent(by: float) -> dict[str, Any]:
    """A pose whose R·Rᵀ deviates from the identity by about ``by``."""
    shear = np.eye(3)
    shear[0, 1] = by
    return truth(2) | {"cam_R_m2c": (shear @ np.reshape(R, (3, 3))).ravel().tolist()}


def test_inexact_rotations_are_replaced_and_logged_once(scene, open_test, caplog):
    scene.json("scene_gt", {"3": [bent(5e-3), truth(2)], "11": [bent(9e-3), bent(9e-4)]})
    scene.json("scene_gt_info", {})
    source = open_test()
    source.sample(0)
    (line,) = [line for line in caplog.messages if "orthogonal" in line]
    assert line == "bop/test: 2 rotations are orthogonal to 0.01 only; using the nearest rotations"
    got = source.sample(0).instances[0].T_cam_obj[:3, :3]
    np.testing.assert_allclose(got @ got.T, np.eye(3), atol=1e-12)
    stated = np.reshape(bent(5e-3)["cam_R_m2c"], (3, 3))
    np.testing.assert_allclose(got, polar(stated)[0], atol=1e-12)
    almost = source.sample(1).instances[1].T_cam_obj[:3, :3]
    np.testing.assert_array_equal(almost.ravel(), bent(9e-4)["cam_R_m2c"])  # as it is
    scene.json("scene_gt", {"3": [bent(1.2e-2)]})
    with pytest.raises(UserError, match=r"cam_R_m2c: not a rotation: .*0\.012 \(allowed 1e-02\)"):
        open_test()


def test_missing_infos_and_models_are_accepted_and_counted(scene, open_test, caplog):
    caplog.set_level("INFO")
    scene.json("scene_gt", {"3": [truth(9), truth(2)], "11": [truth(9), truth(2)]})
    scene.json("scene_gt_info", {"3": [{"visib_fract": 0.25}, {"visib_fract": 0.75}]})
    (scene.root / "models").mkdir()
    (scene.root / "models" / "models_info.json").write_text('{"2": {"diameter": 46.0}}')
    source = open_test()
    assert "ignoring objects without a model: 9 (2)" in caplog.text
    assert "none of the parts" not in caplog.text
    assert "1 objects' visible fractions are estimated" in caplog.text
    fractions = [source.sample(i).instances[0].visible_fraction for i in (0, 1)]
    assert fractions == pytest.approx([0.75, 1.0])


def test_a_list_of_targets_marks_the_most_visible_instances(scene, open_test, caplog):
    truths = [truth(2, (x, 0, 250)) for x in (-30.0, -10.0, 10.0, 30.0)]
    scene.annotate({"3": truths, "11": [truth(2)]}, {"3": [0.2, 0.9, 0.05, 0.5], "11": [0.8]})
    path = scene.root / TARGETS

    def wanted(count, **options):
        listed = {"scene_id": 1, "im_id": 3, "obj_id": 2, "inst_count": count}
        path.write_text(json.dumps([listed]))
        source = open_test(**options)
        return len(source), [instance.wanted for instance in source.sample(0).instances]

    assert wanted(2, targets="auto") == (1, [False, True, False, True])
    assert "no annotation" not in caplog.text
    wanted(7, targets="auto")
    assert "bop/test: 3 listed instances have no annotation or no model" in caplog.text
    assert wanted(7) == (2, [None] * 4)
    path.unlink()
    assert len(open_test(targets="auto")) == 2


def test_the_view_has_the_first_camera_and_the_range_of_depths(scene, open_test):
    scene.annotate({"3": [truth(2, (0, 0, 251.0)), truth(9)], "11": [truth(2, (0, 0, 309.0))]}, {})
    size, camera, distances = open_test().view()
    assert (size, distances) == ((64, 48), (0.25, 0.31))
    np.testing.assert_array_equal(camera, np.reshape(K, (3, 3)))
    scene.annotate({"3": [truth(9)], "11": []}, {})
    assert open_test().view()[2] is None


def test_the_published_linemod_occlusion(shared_data):
    root = shared_data / "lmo_bop"
    if not root.is_dir():
        pytest.skip(f"no {root}")
    report = check_dataset(root)
    assert report.ok, report.lines()
    assert any("105 rotations are orthogonal" in note for note in report.notes)
    parts = bop_parts(root)
    source = BopReader(root, parts, "test")
    for item in [item for index in range(3) for item in source.sample(index).instances]:
        rotation = item.T_cam_obj[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-3)
    assert all(part.mesh.colours is not None for part in parts)


def test_nested_matrices_and_integers_are_accepted(tmp_path):
    scene = Scene(tmp_path)
    nested = truth(1) | {"cam_R_m2c": np.reshape(R, (3, 3)).tolist(), "cam_t_m2c": [[0], [0], [9]]}
    scene.annotate({"0": [nested]}, {"0": [1]})
    scene.image("rgb/000000.png", np.zeros((48, 64, 3), np.uint8))
    (instance,) = BopReader(tmp_path, [block(1)], "test").sample(0).instances
    np.testing.assert_allclose(instance.T_cam_obj[:3, 3], [0, 0, 0.009])
    np.testing.assert_array_equal(instance.T_cam_obj[:3, :3], np.reshape(R, (3, 3)))


def test_files_that_contradict_an_image_are_rejected(scene, open_test):
    def refused(match, **options):
        with pytest.raises(UserError, match=match):
            open_test(**options).sample(0)

    content = (scene.folder / "rgb" / "000003.png").read_bytes()
    (scene.folder / "rgb" / "000003.jpg").write_bytes(content)
    refused(r"rgb/000003.*: image 3 twice, also as 000003.*one file per image")
    (scene.folder / "rgb" / "000003.png").unlink()
    scene.json("scene_camera", {"3": {"cam_K": K}, "11": {"cam_K": K}})
    scene.image("depth/000003.png", np.zeros((48, 64), np.uint16))
    refused(r"depth/000003.png: image: no depth_scale")
    far = [*K[:2], 500.0, *K[3:]]
    scene.json("scene_camera", {"3": {"cam_K": far}, "11": {"cam_K": K}})
    refused(r"K with .*cx=500.*image 3", read_depth=False)


def test_wrong_folders_are_rejected(scene, tmp_path):
    def refused(match, root=scene.root, split="test"):
        with pytest.raises(UserError, match=match):
            BopReader(root, [block(2)], split)

    refused(r"train_pbr, which is not a folder; allowed: one of \['test", split="train_pbr")
    (tmp_path / "empty" / "test").mkdir(parents=True)
    refused("which has no scene", tmp_path / "empty")
    for path in (scene.folder / "rgb").iterdir():
        path.unlink()
    refused(r"no image under .* \(2 listed\)")
    (scene.folder / "scene_camera.json").unlink()
    refused(r"scene_camera\.json, no such file")


def test_palettes_alpha_and_single_bits_are_decoded():
    def saved(mode):
        buffer = io.BytesIO()
        Image.new("L", (5, 4)).convert(mode).save(buffer, "PNG")
        return buffer.getvalue()

    for mode in ("P", "RGBA"):
        assert decode_rgb(saved(mode), "x").shape == (4, 5, 3)
    assert not decode_mask(saved("1"), "x", (4, 5)).any()
    with pytest.raises(UserError, match="type RGB"):
        decode_mask(encode_image(np.zeros((4, 5, 3), np.uint8)), "x", (4, 5))
