"""``dopepp check``: correct data sets pass, and check and reader report each damage."""

import json
import logging
import re
import shutil
import tarfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.data.check import check_dataset
from dopepp.data.formats.bop.bop_models import bop_parts
from dopepp.data.formats.bop.bop_reader import BopReader
from dopepp.data.formats.problems import MAX_KEPT, CheckReport
from dopepp.data.formats.webdataset.webdataset_reader import WebdatasetReader
from dopepp.data.formats.ycb_video.ycb_reader import YcbVideoReader
from dopepp.geometry.camera import camera_matrix
from tests.data.makers import LAYOUTS, edit_json, write_set, write_tar

SIZE, NUM_IMAGES = 128, 3
SIDES = np.array([60.0, 40.0, 24.0])  # mm, of both boxes
SMALL = np.zeros((SIZE // 2, SIZE), np.uint8)
NOISE = np.random.default_rng(9).integers(0, 255, (SIZE, SIZE, 3), np.uint8)


class Case(NamedTuple):
    """A damage and the check's report.

    ``place`` is a file or, after a colon, the keys of a value in its JSON. A ``value`` of None
    removes the file or value, a function changes it, and an array is an image. The reader rejects
    the damage with file and field unless ``is_read``.
    """

    place: str
    value: Any
    found: str
    is_read: bool = False


def read(place: str, value: Any, found: str) -> Case:
    """Return a damage that the reader accepts or does not read."""
    return Case(place, value, found, is_read=True)


def spoilt(content: bytes, keys: str, value: Any) -> bytes | None:
    if not keys:
        new = value(content) if callable(value) else value
        return cv2.imencode(".png", new)[1].tobytes() if isinstance(new, np.ndarray) else new
    tree = node = json.loads(content)
    *path, last = keys.split(".")
    for name in path:
        node = node[int(name) if isinstance(node, list) else name]
    key = int(last) if isinstance(node, list) else last
    if value is None:
        del node[key]
    else:
        node[key] = value(node[key]) if callable(value) else value
    return json.dumps(tree).encode()


def spoil(root: Path, place: str, value: Any) -> None:
    file, _, keys = place.partition(":")
    path = root / file
    content = spoilt(path.read_bytes() if path.exists() else b"", keys, value)
    path.unlink() if content is None else path.write_bytes(content)


def spoil_shard(root: Path, place: str, value: Any) -> None:
    """Damage a member of the shard's first image; the order of the members is kept."""
    name, _, keys = f"{FIRST}.{place}".partition(":")
    members = [(n, spoilt(c, keys, value) if n == name else c) for n, c in members_of(root / SHARD)]
    write_tar(root / SHARD, [(n, c) for n, c in members if c is not None])


def members_of(path: Path) -> list[tuple[str, bytes]]:
    with tarfile.open(path) as archive:
        return [(info.name, archive.extractfile(info).read()) for info in archive.getmembers()]


def times(by: float) -> Callable[[Any], Any]:
    return lambda value: (by * np.array(value)).tolist()


def instead(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda content: content.replace(old, new, 1)


def half(content: bytes) -> bytes:
    return content[: len(content) // 2]


def intrinsics(fx: float, cx: float) -> list[float]:
    return [fx, 0, cx, 0, 150, 63, 0, 0, 1]


def turn(quaternion: list[float]) -> list[float]:
    turned = Rotation.from_euler("xyz", [0.2, 0.3, 0.4]) * Rotation.from_quat(quaternion)
    return turned.as_quat().tolist()


def roll(quaternion: list[float]) -> list[float]:
    return np.roll(quaternion, 1).tolist()


def flip_box(box: dict[str, list[float]]) -> dict[str, list[float]]:
    return {name: corner[::-1] for name, corner in box.items()}


SCENE = "train_pbr/000000"
GT, CAMERA, INFO = (f"{SCENE}/scene_{name}.json" for name in ("gt", "camera", "gt_info"))
MODELS = "models/models_info.json"
RGB, DEPTH = f"{SCENE}/rgb/000001.png", f"{SCENE}/depth/000002.png"
MASK, VISIBLE = f"{SCENE}/mask/000000_00000", f"{SCENE}/mask_visib/000000_00000"
GREY_16, DIAGONAL = NOISE[..., 0].astype(np.uint16), np.eye(SIZE, dtype=np.uint8) * 255
ROTATION, PLACE = f"{GT}:0.0.cam_R_m2c", f"{GT}:0.1.cam_t_m2c"
SYMMETRY, AXIS = f"{MODELS}:1.symmetries_discrete.0", f"{MODELS}:2.symmetries_continuous.0.axis"
PLY_IN_METRES = trimesh.creation.box(SIDES / 1000).export(file_type="ply")
BOP = {
    "rgb cut": Case(RGB, half, "rgb/000001.png: image: unreadable"),
    "rgb empty": read(RGB, b"", "rgb/000001.png: image: unreadable"),
    "rgb missing": read(RGB, None, "rgb/000001.png: file: missing"),
    "rgb of 16 bits": Case(RGB, GREY_16, "rgb/000001.png: image: pixels of type I;16"),
    "rgb without records": read(f"{SCENE}/rgb/000009.png", NOISE, "scene_camera.json: 9: missing"),
    "depth cut": Case(DEPTH, half, "depth/000002.png: image: unreadable"),
    "depth missing": Case(DEPTH, None, "depth/000002.png: file: missing"),
    "depth size": Case(DEPTH, SMALL, "depth/000002.png: size: 128×64 pixels; allowed: 128×128"),
    "depth colour": Case(DEPTH, NOISE, "depth/000002.png: channels: "),
    "mask cut": read(f"{MASK}1.png", half, "000001.png: image: unreadable"),
    "mask missing": read(f"{VISIBLE}1.png", None, "000000_000001.png: file: missing"),
    "mask size": Case(f"{VISIBLE}0.png", SMALL, "mask_visib/000000_000000.png: size"),
    "mask of no object": read(f"{MASK}7.png", SMALL, "000000_000007.png: file: no object 7"),
    "mask of another": read(f"{VISIBLE}1.png", DIAGONAL, "scene_gt.json: 0[1].mask_visib:"),
    "gt missing": read(GT, None, "scene_gt.json: file: missing"),
    "camera missing": Case(CAMERA, None, "scene_camera.json: file: missing"),
    "gt cut": Case(GT, half, "scene_gt.json: JSON: line"),
    "gt NaN": Case(GT, instead(b'"obj_id": 1', b'"obj_id": NaN'), "scene_gt.json: JSON: 'NaN'"),
    "gt list": Case(GT, b"[]", "scene_gt.json: top level"),
    "no gt": read(f"{GT}:1", None, "scene_gt.json: 1: missing"),
    "no camera": read(f"{CAMERA}:1", None, "scene_camera.json: 1: missing"),
    "one info less": Case(f"{INFO}:1.0", None, "gt_info.json: 1: 1 objects; allowed: 2"),
    "duplicate image": read(GT, instead(b'"1": [', b'"01": [], "1": ['), "image 1 twice"),
    "duplicate key": Case(GT, instead(b'"1": [', b'"1": [], "1": ['),
                          "scene_gt.json: JSON: key '1' twice"),
    "not an image number": Case(f"{GT}:x", [], "scene_gt.json: 'x': not an image number"),
    "rotation scaled": Case(ROTATION, times(1.01), "0[0].cam_R_m2c: not a rotation"),
    "rotation mirrored": Case(ROTATION, times(-1), "0[0].cam_R_m2c: not a rotation"),
    "rotation gone": Case(ROTATION, None, "0[0].cam_R_m2c: missing"),
    "rotation of words": Case(ROTATION, ["a"] * 9, "0[0].cam_R_m2c: ['a'"),
    "behind": read(PLACE, [0.0, 0, -400], "0[1].cam_t_m2c.z: behind the camera"),
    "metres": read(f"{GT}:2.0.cam_t_m2c", times(0.001), "2[0].cam_t_m2c.unit:"),
    "moved": read(PLACE, [90.0, 0.0, 340.0], "0[1].box: visible at"),
    "too near": read(PLACE, times(0.25), "0[1].box: "),
    "huge number": Case(f"{GT}:0.0.cam_t_m2c", [10**400, 0, 0], "0[0].cam_t_m2c:"),
    "object no record": Case(f"{GT}:0.0", 5, "0[0]: 5"),
    "focal length": read(f"{CAMERA}:0.cam_K", intrinsics(-150.0, 64), "camera.json: 0.cam_K:"),
    "principal point": read(f"{CAMERA}:0.cam_K", intrinsics(150.0, 640), "cx=640"),
    "aspect": read(f"{CAMERA}:0.cam_K", intrinsics(450.0, 64), "fx/fy = 3"),
    "no pinhole": read(f"{CAMERA}:0.cam_K", [1.0] * 9, "0.cam_K: K"),
    "K short": Case(f"{CAMERA}:0.cam_K", [1.0], "0.cam_K: [1.0]"),
    "depth scale": Case(f"{CAMERA}:0.depth_scale", 0, "0.depth_scale: 0"),
    "no depth scale": read(f"{CAMERA}:0.depth_scale", None, "0.depth_scale: missing"),
    "fraction": Case(f"{INFO}:0.0.visib_fract", 1.5, "0[0].visib_fract: 1.5"),
    "fraction and counts": read(f"{INFO}:0.1.visib_fract", 0.2, "0[1].visib_fract: 0.2, but"),
    "counts": read(f"{INFO}:0.1.px_count_visib", times(1.5), "0[1].px_count_visib"),
    "visible box": read(f"{INFO}:0.1.bbox_visib", [0, 0, 20, 20], "0[1].bbox_visib:"),
    "diameter in m": read(f"{MODELS}:1.diameter", times(0.001), "1.unit: 0.0"),
    "diameter and box": read(f"{MODELS}:1.diameter", times(2), "1.diameter: 1"),
    "symmetry": Case(SYMMETRY, times(2), "1.symmetries_discrete[0]: not a rotation"),
    "axis": Case(AXIS, times(0), "2.symmetries_continuous[0].axis: zero"),
    "model cut": read("models/obj_000002.ply", b"ply\n", "obj_000002.ply: mesh: with no PLY"),
    "model in m": read("models/obj_000001.ply", PLY_IN_METRES, "models/obj_000001.ply: mesh: part "
                       "'obj_000001' with a diameter of 7.6e-05"),
}  # fmt: skip

FIRST, SHARD = "000000_000000", "train_pbr/shard-000000.tar"
WEBDATASET = {
    "image cut": read("rgb.png", half, f"shard-000000.tar/{FIRST}.rgb.png: image: unreadable"),
    "no image": read("rgb.png", None, f"{FIRST}.rgb.png: member: missing"),
    "no camera": read("camera.json", None, f"{FIRST}.camera.json: member: missing"),
    "depth size": read("depth.png", SMALL, f"{FIRST}.depth.png: size"),
    "behind": read("gt.json:0.cam_t_m2c", [0, 0, -1], f"{FIRST}.gt.json: [0].cam_t_m2c.z: behind"),
    "gt of no list": Case("gt.json", b'{"a": 1}', f"{FIRST}.gt.json: "),
    "gt cut": Case("gt.json", half, f"{FIRST}.gt.json: JSON: "),
    "K short": Case("camera.json:cam_K", [1.0], f"{FIRST}.camera.json: cam_K"),
    "one info": Case("gt_info.json:0", None, f"{FIRST}.gt_info.json: "),
    "runs": Case("mask_visib.json:0.counts", [5], f"{FIRST}.mask_visib.json: 0: counts"),
    "mask gone": Case("mask_visib.json:1", None, f"{FIRST}.mask_visib.json: 1: missing"),
}

OBJECT, RECORD = "000000.json:objects.0", "000000.json:camera_data"
SETTINGS, BOX = "_object_settings.json", f"{OBJECT}.bounding_box"
QUATERNION, LOCATION = f"{OBJECT}.quaternion_xyzw", f"{OBJECT}.location"
NINES = np.full((SIZE, SIZE), 9, np.uint8)
LENGTHS = ("cuboid", "location", "cuboid_centroid")
NDDS = {
    "image cut": Case("000001.png", half, "000001.png: image: unreadable"),
    "image missing": read("000001.png", None, "000001.json: image: missing"),
    "depth cut": read("000001.depth.png", b"\x89PNG", "000001.depth.png: image: of 4 bytes"),
    "depth missing": read("000001.depth.png", None, "000001.depth.png: file: missing"),
    "depth size": Case("000001.depth.png", SMALL, "000001.depth.png: size: 128×64"),
    "seg missing": read("000001.seg.png", None, "000001.seg.png: file: missing"),
    "seg size": Case("000001.seg.png", SMALL, "000001.seg.png: size"),
    "seg of nobody": read("000001.seg.png", NINES, "000001.seg.png: values: [9]"),
    "annotation missing": read("000001.json", None, "000001.png: annotation: missing: no 000001.j"),
    "annotation cut": Case("000001.json", half, "000001.json: JSON: line"),
    "annotation list": Case("000001.json", b"[]", "000001.json: top level"),
    "no objects": Case("000000.json:objects", None, "000000.json: objects: missing"),
    "object no record": Case("000000.json:objects", lambda objects: [*objects, 3],
                             "000000.json: objects[2]: 3"),
    "NaN": read(LOCATION, [float("nan"), 0, 40], "objects[0].location: not finite"),
    "unknown class": read(f"{OBJECT}.class", "ball", "objects[0].class: unknown object 'ball'"),
    "class of number": Case(f"{OBJECT}.class", 5, "objects[0].class: 5"),
    "no rotation": read(QUATERNION, times(1.1), "quaternion_xyzw: norm"),
    "no location": Case(LOCATION, None, "objects[0].location: missing"),
    "another rotation": read(QUATERNION, turn, "[0].quaternion_xyzw: not the cuboid's orientation"),
    "another order": read(QUATERNION, roll, "[0].quaternion_xyzw: w, x, y, z; 5 objects"),
    "behind": read(LOCATION, [0, 0, -40], "objects[0].location.z: behind the camera"),
    "metres": read(LOCATION, times(0.01), "objects[0].location.unit: "),
    "cuboid in m": read(OBJECT, lambda entry: entry | {n: times(0.01)(entry[n]) for n in LENGTHS},
                        "objects[0].cuboid.unit: edges"),
    "cuboid of another": read(f"{SETTINGS}:exported_objects.0.cuboid_dimensions", [9, 4, 2],
                              "objects[0].cuboid.size: edges"),
    "cuboid no box": read(f"{OBJECT}.cuboid.3.0", 99.0, "objects[0].cuboid: not a box"),
    "cuboid short": Case(f"{OBJECT}.cuboid", [[1, 2, 3]], "objects[0].cuboid: [[1, 2, 3]]"),
    "cuboid order": read(f"{OBJECT}.cuboid", lambda corners: corners[::-1], "objects[0]."),
    "centroid": read(f"{OBJECT}.cuboid_centroid", [0, 0, 40], "objects[0].cuboid_centroid: "),
    "projection": read(f"{OBJECT}.projected_cuboid.0.0", 0.0, "objects[0].projected_cuboid: "),
    "projected centroid": read(f"{OBJECT}.projected_cuboid_centroid", [0, 0],
                               "objects[0].projected_cuboid_centroid: "),
    "pose transform": read(f"{OBJECT}.pose_transform.0.0", 5.0,
                           "objects[0].pose_transform: not a rotation"),
    "pose transform place": read(f"{OBJECT}.pose_transform.3.0", 5.0,
                                 "objects[0].pose_transform: translation"),
    "visibility": Case(f"{OBJECT}.visibility", 4, "objects[0].visibility: 4"),
    "bounding box": read(BOX, {"top_left": [0, 0], "bottom_right": [9, 9]},
                         "objects[0].bounding_box: (0, 0)–(9, 9) does not contain"),
    "bounding box turned": read(BOX, {"top_left": [9, 9], "bottom_right": [0, 0]},
                                "objects[0].bounding_box: top_left"),
    "bounding box order": read(BOX, flip_box, "objects[0].bounding_box: column, row; 5 objects"),
    "mask of another": read("000000.json:objects", lambda objects: [
        entry | {"segmentation_id": 3 - entry["segmentation_id"]} for entry in objects
    ], "objects[0].box: visible at"),
    "ids twice": read(f"{OBJECT}.segmentation_id", 2, "objects.segmentation_id: 2 twice"),
    "instances twice": read(f"{OBJECT}.instance_id", 2, "objects.instance_id: 2 twice"),
    "principal point": read(f"{RECORD}.intrinsics.cx", 999, "camera_data.intrinsics: K with"),
    "aspect": read(f"{RECORD}.intrinsics.fx", 450, "camera_data.intrinsics: "),
    "size": read(f"{RECORD}.width", 640, "camera_data.size: 640×128; the image has 128×128"),
    "settings cut": Case(SETTINGS, half, f"{SETTINGS}: JSON"),
    "settings class": read(f"{SETTINGS}:exported_objects.1", None,
                           f"{SETTINGS}: exported_objects: no entry for class 'obj_000002'"),
}  # fmt: skip

DAMAGES = {"BOP": (BOP, spoil), "BOP-WebDataset": (WEBDATASET, spoil_shard), "NDDS": (NDDS, spoil)}


@pytest.fixture(scope="session")
def good_sets(tmp_path_factory, boxes):
    """A correct data set of each layout with a writer; tests change copies only."""
    root = tmp_path_factory.mktemp("good")
    for layout, (writer, _) in LAYOUTS.items():
        write_set(writer, root / layout, *boxes)
    return root


@pytest.fixture
def copy_of(good_sets, tmp_path):
    return lambda layout: shutil.copytree(good_sets / layout, tmp_path / layout)


@pytest.mark.parametrize(
    ("layout", "below"),
    [("BOP", ("", "train_pbr", SCENE)), ("BOP-WebDataset", ("", "train_pbr")), ("NDDS", ("",))],
)
def test_a_correct_data_set_has_no_defects_at_any_level(good_sets, layout, below):
    for folder in below:
        report = check_dataset(good_sets / layout / folder)
        found = (report.layout, report.num_images, report.defects, report.notes, report.ok)
        assert found == (layout, NUM_IMAGES, [], [], True)


def assert_found(root: Path, *expected: str) -> None:
    """Check that the defects contain each damage with its file and field."""
    report = check_dataset(root)
    for text in expected:
        assert any(text in line for line in report.defects), (text, report.defects)
    assert not report.ok


def assert_refused(make_reader: Callable[[], Any], expected: str) -> None:
    """Check that the reader raises the check's message in one line, with file and field."""

    def read_all() -> None:
        reader = make_reader()
        for index in range(len(reader)):
            reader.sample(index)

    with pytest.raises(UserError) as caught:
        read_all()
    line = str(caught.value)
    assert all(part in line for part in expected.split(": ")[:2])
    assert "\n" not in line
    assert len(line) < 800


@pytest.mark.parametrize(
    ("layout", "name"), [(layout, name) for layout, (table, _) in DAMAGES.items() for name in table]
)
def test_check_and_reader_report_every_damage_with_file_and_field(copy_of, boxes, layout, name):
    (table, damage), root = DAMAGES[layout], copy_of(layout)
    case = table[name]
    damage(root, case.place, case.value)
    assert_found(root, case.found)
    if not case.is_read:
        assert_refused(partial(LAYOUTS[layout][1], root, boxes[0]), f"{case.found}: ")


INDEPENDENT = [
    ("BOP", ("rgb cut", "depth missing", "mask cut", "rotation scaled", "behind", "metres",
             "no camera", "diameter and box", "model cut", "K short", "fraction")),
    # NaN is not valid JSON, but the file's other records are checked.
    ("BOP", ("behind", "gt NaN")),
    # Without a location, no projection can be checked.
    ("NDDS", ("image cut", "depth missing", "seg size", "NaN", "unknown class", "no rotation",
              "visibility", "size", "settings class", "pose transform")),
]  # fmt: skip


@pytest.mark.parametrize(("layout", "names"), INDEPENDENT)
def test_every_defect_is_reported(copy_of, layout, names):
    table, root = DAMAGES[layout][0], copy_of(layout)
    for name in names:
        spoil(root, table[name].place, table[name].value)
    assert_found(root, *(table[name].found for name in names))


NOTED = {
    "a rotation to a hundredth": (f"{GT}:0.0.cam_R_m2c", times(1.004), "1 rotations are orthog"),
    "an image without info": (f"{INFO}:1", None, "2 objects without visib_fract"),
    "no info at all": (INFO, None, "6 objects without visib_fract"),
    "an image of empty info": (f"{INFO}:1", [], "2 objects without visib_fract"),
    "an object of null info": (f"{INFO}:1.0", lambda info: None, "1 objects without visib_fract"),
    "an object of a box only": (f"{INFO}:0.0.visib_fract", None, "1 objects without visib_fract"),
    "a model missing": ("models/obj_000002.ply", None, "no file of object 2, whose annotations"),
    "an object without a model": (f"{GT}:0.0.obj_id", 9, "object 9 is annotated 1 times and has"),
}


@pytest.mark.parametrize("name", NOTED)
def test_deviations_that_readers_accept_are_notes(copy_of, name):
    root, (place, value, expected) = copy_of("BOP"), NOTED[name]
    spoil(root, place, value)
    report = check_dataset(root)
    assert report.ok, report.lines()
    assert any(expected in note for note in report.notes), report.notes


def test_private_ground_truth_and_missing_models_are_notes(copy_of):
    root = copy_of("BOP")
    for name in (GT, INFO, MODELS):
        (root / name).unlink()
    for folder in ("mask", "mask_visib"):
        shutil.rmtree(root / SCENE / folder)
    report = check_dataset(root)
    assert report.ok
    assert any("has no scene_gt.json" in note for note in report.notes)
    assert any("models_info.json" in note for note in report.notes)


@pytest.mark.parametrize(
    ("place", "value"),
    [(f"{INFO}:0.1.visib_fract", 1.0000001), (f"{MODELS}:1.symmetries_discrete.0.0", times(1.004))],
)
def test_check_and_reader_accept_rounded_values(copy_of, place, value):
    root = copy_of("BOP")
    spoil(root, place, value)
    assert check_dataset(root).lines()[:-1] == []
    parts = bop_parts(root)
    instances = BopReader(root, parts, "train_pbr").sample(0).instances
    assert all(0 < instance.visible_fraction <= 1 for instance in instances)
    symmetry = parts[0].symmetries_discrete[0, :3, :3]
    np.testing.assert_allclose(symmetry @ symmetry.T, np.eye(3), atol=1e-12)


def test_image_and_depth_are_matched_by_number(copy_of, boxes):
    root = copy_of("BOP")
    (root / SCENE / "rgb" / "000001.png").rename(root / SCENE / "rgb" / "1.png")
    assert check_dataset(root).ok
    np.testing.assert_allclose(BopReader(root, boxes[0], "train_pbr").sample(1).depth, 0.4)


def test_an_empty_depth_folder_means_no_depth(copy_of, boxes):
    root = copy_of("BOP")
    for path in (root / SCENE / "depth").iterdir():
        path.unlink()
    assert check_dataset(root).ok
    assert BopReader(root, boxes[0], "train_pbr").sample(0).depth is None


def test_a_scene_folder_without_a_number_is_a_defect(copy_of):
    root = copy_of("BOP")
    (root / SCENE).rename(root / "train_pbr" / "kitchen")
    assert_found(root, "train_pbr/kitchen: name: not a scene number")


@pytest.mark.parametrize("stated", [b"[]", b"[null, null]"])
def test_shards_may_lack_visible_fractions(copy_of, boxes, stated):
    root = copy_of("BOP-WebDataset")
    spoil_shard(root, "gt_info.json", stated)
    report = check_dataset(root)
    assert report.ok, report.lines()
    assert any("2 objects without visib_fract" in note for note in report.notes)
    instances = WebdatasetReader(root, boxes[0], "train_pbr").sample(0).instances
    assert all(0 < instance.visible_fraction <= 1 for instance in instances)


LISTS = {
    "archive: member '../evil.rgb.png'": lambda members: [("../evil.rgb.png", b"x"), *members],
    f"{FIRST}.gt.json' twice": lambda members: [*members, (f"{FIRST}.gt.json", b"[]")],
    f"{FIRST}: key: its members are not together": lambda members: [*members[1:], members[0]],
    "key_to_shard.json: 9_9: missing": lambda members: members + [
        (name.replace(FIRST, "9_9"), content) for name, content in members if FIRST in name
    ],
}  # fmt: skip


@pytest.mark.parametrize("expected", LISTS)
def test_members_out_of_order_are_reported(copy_of, expected):
    root = copy_of("BOP-WebDataset")
    write_tar(root / SHARD, LISTS[expected](members_of(root / SHARD)))
    assert_found(root, expected)


def test_defects_in_a_damaged_archive_are_reported(copy_of):
    root = copy_of("BOP-WebDataset")
    spoil_shard(root, "gt.json:0.cam_t_m2c", [0, 0, -1])
    members = members_of(root / SHARD)
    members[2:2] = [("../evil.txt", b"x"), members[0]]
    write_tar(root / SHARD, members)
    (root / "train_pbr" / "shard-000001.tar").write_bytes(b"\x1f\x8b" + bytes(600))
    assert_found(root, "000000.tar: archive", "behind the camera", "twice", "000001.tar: archive")
    assert check_dataset(root).num_images == NUM_IMAGES


@pytest.mark.parametrize(
    ("field", "change", "note"),
    [("quaternion_xyzw", roll, "w, x, y, z"), ("bounding_box", flip_box, "column, row")],
)
def test_conventions_of_a_whole_data_set_are_notes(copy_of, field, change, note):
    root = copy_of("NDDS")
    for path in root.glob("0*.json"):
        for number in (0, 1):
            spoil(root, f"{path.name}:objects.{number}.{field}", change)
    report = check_dataset(root)
    assert (report.defects, report.notes) == ([], [f"{field}: {note} (6 objects)"])


def of_old_nvisii(record: dict[str, Any]) -> None:
    """Turn y up and z backwards; keep projections and no cuboid in space."""
    for entry in record["objects"]:
        entry["location"] = (np.array([1, -1, -1]) * entry["location"] / 100).tolist()
        rotation = Rotation.from_quat(entry["quaternion_xyzw"]).as_matrix()
        turned = Rotation.from_matrix(np.diag([1, -1, -1]) @ rotation)
        entry["quaternion_xyzw"] = turned.as_quat().tolist()
        entry["projected_cuboid"].append(entry.pop("projected_cuboid_centroid"))
        for field in ("cuboid", "cuboid_centroid", "pose_transform", "bounding_box"):
            del entry[field]


def test_opengl_files_without_cuboids_have_no_defects(copy_of):
    root = copy_of("NDDS")
    (root / SETTINGS).unlink()
    for path in root.glob("0*.json"):
        edit_json(path, of_old_nvisii)
    report = check_dataset(root)
    assert (report.defects, report.notes) == ([], ["camera axes: OpenGL (6 objects)"])


def test_invisible_objects_may_be_behind_the_camera(copy_of):
    root = copy_of("NDDS")
    spoil(root, f"{OBJECT}.visibility", 0)
    spoil(root, f"{OBJECT}.location.2", lambda z: -z)
    for field in ("cuboid", "cuboid_centroid", "pose_transform", "projected_cuboid"):
        spoil(root, f"{OBJECT}.{field}", None)
    assert check_dataset(root).defects == []


FRAME = "0000/000001"


@pytest.fixture
def ycb(ycb_tree):
    rng = np.random.default_rng(0)
    for name in ("002_can", "003_box", "004_mug"):
        folder = ycb_tree.root / "models" / name
        folder.mkdir(parents=True)
        np.savetxt(folder / "points.xyz", rng.uniform(-1, 1, (500, 3)) * (0.04, 0.03, 0.02))
    for frame, classes in ((FRAME, (2,)), ("0000/000002", (2,)), ("data_syn/000000", (1,))):
        ycb_tree.write(frame, classes)
    ycb_tree.path(FRAME, "box.txt").write_text("003_box 30 20 60 50\n")
    ycb_tree.write_list("train", [FRAME, "data_syn/000000"])
    return ycb_tree


def poses(**changes: Any) -> Callable[[Any], None]:
    """Write the frame with changed elements of its pose: ``R00=2``, ``tz=-1``."""

    def damage(tree: Any) -> None:
        stack = tree.write(FRAME)
        for name, value in changes.items():
            place = (int(name[1]), int(name[2])) if name[0] == "R" else ("xyz".index(name[1]), 3)
            stack[(*place, 0)] = value
        tree.write(FRAME, poses=stack)

    return damage


def meta(**fields: Any) -> Callable[[Any], Any]:
    return lambda tree: tree.write(FRAME, **fields)


def file(what: str, value: Any) -> Callable[[Any], Any]:
    return lambda tree: spoil(tree.root, f"data/{FRAME}-{what}", value)


def names(kind: str, *lines: str) -> Callable[[Any], Any]:
    return lambda tree: tree.write_list(kind, list(lines))


OTHER_K = camera_matrix(100.0, 100.0, 999.0, 35.0)
YCB_VIDEO = {
    "colour cut": (file("color.png", half), "color.png: image: of "),
    "depth missing": (file("depth.png", None), "depth.png: file: missing"),
    "label missing": (file("label.png", None), "label.png: file: missing"),
    "meta missing": (file("meta.mat", None), "meta.mat: file: No such file"),
    "meta cut": (file("meta.mat", half), "meta.mat: file: "),
    "label size": (file("label.png", np.zeros((9, 9), np.uint8)), "label.png: size: 9×9"),
    "depth size": (file("depth.png", np.zeros((9, 9), np.uint16)), "depth.png: size: 9×9"),
    "label colour": (file("label.png", np.zeros((72, 96, 3), np.uint8)), "label.png: channels: "),
    "no rotation": (poses(R00=1.1), "meta.mat: poses[0].R: not a rotation"),
    "NaN": (poses(R00=np.nan), "meta.mat: poses[0]: not finite"),
    "behind": (poses(tz=-0.3), "meta.mat: poses[0].z: behind the camera"),
    "class twice": (meta(classes=(2, 3), cls_indexes=[[2], [2]]), "cls_indexes[1]: class 2 twice"),
    "poses and classes": (meta(cls_indexes=[[2], [3]]), "poses: shape"),
    "no poses": (meta(poses=None), "meta.mat: poses: missing"),
    "no factor": (meta(factor_depth=None), "meta.mat: factor_depth: missing"),
    "factor": (meta(factor_depth=-1), "meta.mat: factor_depth: -1"),
    "K NaN": (meta(intrinsic_matrix=np.full((3, 3), np.nan)), "intrinsic_matrix: not finite"),
    "list": (names("train", "0000/x"), "image_sets/train.txt: line: line '0000"),
}
"""Damages that the check reports and the reader rejects."""

YCB_VIDEO_READ = {
    "colour missing": (file("color.png", None), "color.png: file: missing"),
    "colour of another kind": (file("color.png", SMALL), "color.png: image: of shape (64, 128)"),
    "meta empty": (file("meta.mat", b""), "meta.mat: file: damaged"),
    "label of nobody": (file("label.png", np.full((72, 96), 3, np.uint8)),
                        "label.png: values: classes [3] without a pose"),
    "mirrored": (poses(R22=-1), "determinant -1"),
    "millimetres": (poses(tz=300.0), "meta.mat: poses[0].unit: "),
    "moved": (poses(tx=0.1), "meta.mat: poses[0].box: visible at"),
    "unknown class": (meta(cls_indexes=[[9]]), "cls_indexes[0]: unknown class 9"),
    "K": (meta(intrinsic_matrix=OTHER_K), "meta.mat: intrinsic_matrix: K"),
    "box of words": (file("box.txt", b"003_box a b c d\n"), "box.txt: line 1: '003_box a"),
    "box of nobody": (file("box.txt", b"x 1 2 3 4\n"), "box.txt: line 1: unknown object 'x'"),
    "box turned": (file("box.txt", b"003_box 9 9 2 2\n"), "box.txt: line 1: '003_box 9"),
    "box outside": (file("box.txt", b"003_box 300 9 400 20\n"), "outside the 96×72 image"),
    "points": (lambda tree: spoil(tree.root, "models/003_box/points.xyz", b"1 2\n"),
               "models/003_box/points.xyz: points: "),
    "class list": (names("classes", "003_box", "003_box"), "classes.txt: names: "),
}  # fmt: skip
"""Damages that only the check reports, or the reader reports with another message."""


@pytest.mark.parametrize("name", [*YCB_VIDEO, *YCB_VIDEO_READ])
def test_check_and_reader_report_every_damage_of_ycb_video(ycb, box, name):
    damage, expected = (YCB_VIDEO | YCB_VIDEO_READ)[name]
    damage(ycb)
    assert_found(ycb.root, expected)
    assert check_dataset(ycb.root).num_images == 3
    if name in YCB_VIDEO:
        assert_refused(partial(YcbVideoReader, ycb.root, [box], "train"), expected)


def test_every_defect_of_a_frame_is_reported(ycb):
    poses(R00=1.1, tz=-0.3)(ycb)
    for name in ("colour cut", "depth size", "box of nobody"):
        (YCB_VIDEO | YCB_VIDEO_READ)[name][0](ycb)
    expected = ("poses[0].R", "poses[0].z", "color.png: image", "depth.png: size", "line 1")
    assert_found(ycb.root, *expected)


def test_unlabelled_objects_and_missing_models_are_not_defects(ycb):
    assert check_dataset(ycb.root).lines()[:-1] == []
    ycb.write(FRAME, labelled=False)
    shutil.rmtree(ycb.root / "models" / "004_mug")
    ycb.write("0000/000003", (3,))
    ycb.write_list("val", ["0000/000009"])
    report = check_dataset(ycb.root)
    assert report.defects == []
    absent, missing = report.notes
    assert absent.startswith("val.txt lists 1 frames")
    assert missing.startswith("models/004_mug/points.xyz is missing")


def test_the_real_frames_have_no_defects(ycb_root):
    report = check_dataset(ycb_root)
    assert (report.layout, report.num_images, report.defects) == ("YCB-Video", 9, [])
    (note,) = report.notes
    assert note.startswith("keyframe.txt lists 2,948 frames")


def test_report_lines_are_capped_and_counted(tmp_path, caplog):
    report = CheckReport(tmp_path, "BOP")
    for number in range(MAX_KEPT + 5):
        report.report(tmp_path / "a" / f"{number}.json", "0.cam_K", "two\nlines")
    for _ in range(2):
        report.note("worth knowing")
    lines = report.lines(3)
    assert lines[:2] == ["note: worth knowing", "a/0.json: 0.cam_K: two lines"]
    assert lines[4] == f"… and {MAX_KEPT + 2:,} more"
    assert re.search(r"BOP, 0 images, 10,005 defects \(cam_K 10,005\)$", lines[5])
    assert (len(lines), len(report.defects), report.ok) == (6, MAX_KEPT, False)
    with caplog.at_level(logging.INFO):
        for _ in range(1000):
            report.count_image()
    assert "1000 images checked, 10005 defects" in caplog.text


def test_folders_of_scenes_are_one_data_set(tmp_path):
    for name in ("kitchen_0/000000", "forest_1/000000"):
        (tmp_path / name).parent.mkdir()
        for suffix in (".json", ".png"):
            (tmp_path / f"{name}{suffix}").write_text("{}")
    assert check_dataset(tmp_path).layout == "NDDS"


@pytest.mark.parametrize(
    ("name", "message"), [("notes", "a folder of an unknown layout"), ("no", "not a folder")]
)
def test_a_folder_of_unknown_layout_is_rejected(name, message, tmp_path):
    (tmp_path / "notes").mkdir()
    with pytest.raises(UserError, match=message):
        check_dataset(tmp_path / name)


def test_a_data_set_without_images_has_a_defect(tmp_path):
    settings = {"exported_object_classes": [], "exported_objects": []}
    (tmp_path / "_object_settings.json").write_text(json.dumps(settings))
    assert check_dataset(tmp_path).defects == [f"{tmp_path}: images: none found"]
