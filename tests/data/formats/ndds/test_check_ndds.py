"""``dopepp check`` on NDDS: good folders are clean, each damage is found, habits are noted."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.data.check import check_dataset
from dopepp.data.formats.ndds.reader import NddsReader
from dopepp.data.formats.ndds.writer import NddsWriter
from dopepp.data.sample import Instance, Sample
from dopepp.geometry.camera import camera_matrix, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.part import Part

SIZE = 128
K = camera_matrix(150.0, 151.0, 64.0, 63.0)
HALF = np.array([0.03, 0.02, 0.012])
NUM_IMAGES = 3


def make_part(name: str) -> Part:
    cuboid = cuboid_keypoints(-HALF, HALF)
    return Part(name, cuboid, float(2 * np.linalg.norm(HALF)), cuboid[:8], mesh_hash=name)


PARTS = [make_part("box"), make_part("brick")]


def make_sample(seed: int) -> Sample:
    rng = np.random.default_rng(seed)
    instances: list[Instance] = []
    taken = np.zeros((SIZE, SIZE), bool)
    for part, x in zip(PARTS, (-0.04, 0.04), strict=True):
        T = np.eye(4)
        T[:3, :3] = Rotation.random(rng=rng).as_matrix()
        T[:3, 3] = [x, 0.01 * seed, 0.4]
        keypoints = project_keypoints(part.cuboid, T, K)
        canvas = np.zeros((SIZE, SIZE), np.uint8)
        cv2.fillConvexPoly(canvas, cv2.convexHull(np.rint(keypoints[:8]).astype(np.int32)), 1)
        mask = (canvas > 0) & ~taken
        taken |= mask
        instances.append(Instance(part.name, T, keypoints, mask.sum() / canvas.sum(), mask))
    image = rng.integers(0, 256, (SIZE, SIZE, 3), np.uint8)
    return Sample(image, K, instances, np.full((SIZE, SIZE), 0.4, np.float32))


@pytest.fixture
def ndds(tmp_path, write_set):
    samples = [make_sample(index) for index in range(NUM_IMAGES)]
    return write_set(NddsWriter, tmp_path / "ndds", PARTS, samples)


def test_a_good_folder_is_clean(ndds):
    report = check_dataset(ndds)
    assert (report.layout, report.num_images, report.defects) == ("NDDS", NUM_IMAGES, [])
    assert report.notes == []


def times(by: float) -> Callable[[list[float]], list[float]]:
    return lambda values: (by * np.array(values)).tolist()


def cut(content: bytes) -> bytes:
    return content[:-200]


def turn(quaternion: list[float]) -> list[float]:
    turned = Rotation.from_euler("xyz", [0.2, 0.3, 0.4]) * Rotation.from_quat(quaternion)
    return turned.as_quat().tolist()


def roll(quaternion: list[float]) -> list[float]:
    return np.roll(quaternion, 1).tolist()


def flip_box(box: dict[str, list[float]]) -> dict[str, list[float]]:
    return {name: corner[::-1] for name, corner in box.items()}


def in_metres(entry: dict[str, Any]) -> dict[str, Any]:
    fields = ("cuboid", "location", "cuboid_centroid")
    return entry | {name: times(0.01)(entry[name]) for name in fields}


def other_masks(objects: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [entry | {"segmentation_id": 3 - entry["segmentation_id"]} for entry in objects]


SMALL = np.zeros((SIZE // 2, SIZE), np.uint8)
OBJECT, CAMERA = "000000.json:objects.0", "000000.json:camera_data"
SETTINGS = "_object_settings.json"
DAMAGES = {
    "image cut": ("000001.png", cut, "000001.png: image: unreadable"),
    "image missing": ("000001.png", None, "000001.json: image: missing"),
    "depth cut": ("000001.depth.png", b"\x89PNG", "000001.depth.png: image: of 4 bytes"),
    "depth missing": ("000001.depth.png", None, "000001.depth.png: file: missing"),
    "depth size": ("000001.depth.png", SMALL, "000001.depth.png: size: 128×64"),
    "seg missing": ("000001.seg.png", None, "000001.seg.png: file: missing"),
    "seg size": ("000001.seg.png", SMALL, "000001.seg.png: size"),
    "seg of nobody": (
        "000001.seg.png", np.full((SIZE, SIZE), 9, np.uint8), "000001.seg.png: values: [9]"
    ),
    "annotation missing": ("000001.json", None, "000001.png: annotation: missing: no 000001.json"),
    "annotation cut": ("000001.json", cut, "000001.json: JSON: line"),
    "annotation deep": ("000001.json", b"[" * 9999, "000001.json: JSON: brackets"),
    "annotation list": ("000001.json", b"[]", "000001.json: top level"),
    "no objects": ("000000.json:objects", None, "000000.json: objects: missing"),
    "object no record": (
        "000000.json:objects", lambda objects: [*objects, 3], "000000.json: objects[2]: 3"
    ),
    "NaN": (f"{OBJECT}.location", [float("nan"), 0, 40], "objects[0].location: not finite"),
    "key twice": (
        "000001.json", b'{"objects": [], "objects": []}', "000001.json: JSON: key 'objects' twice"
    ),
    "unknown class": (f"{OBJECT}.class", "ball", "objects[0].class: unknown object 'ball'"),
    "class of number": (f"{OBJECT}.class", 5, "objects[0].class: 5"),
    "no rotation": (f"{OBJECT}.quaternion_xyzw", times(1.1), "[0].quaternion_xyzw: no rotation"),
    "zero rotation": (f"{OBJECT}.quaternion_xyzw", times(0), "[0].quaternion_xyzw: no rotation"),
    "short rotation": (f"{OBJECT}.quaternion_xyzw", [1, 0], "objects[0].quaternion_xyzw: [1, 0]"),
    "no location": (f"{OBJECT}.location", None, "objects[0].location: missing"),
    "location of words": (f"{OBJECT}.location", ["a", "b", "c"], "objects[0].location: ['a'"),
    "another rotation": (
        f"{OBJECT}.quaternion_xyzw", turn, "[0].quaternion_xyzw: not the cuboid's orientation"
    ),
    "another order": (
        f"{OBJECT}.quaternion_xyzw", roll, "[0].quaternion_xyzw: w, x, y, z; 5 objects"
    ),
    "behind": (f"{OBJECT}.location", [0, 0, -40], "objects[0].location.z: behind the camera"),
    "metres": (f"{OBJECT}.location", times(0.01), "objects[0].location.unit: "),
    "millimetres": (f"{OBJECT}.location", times(10), "objects[0].location.unit: "),
    "cuboid in m": (OBJECT, in_metres, "objects[0].cuboid.unit: edges"),
    "cuboid of another": (
        f"{SETTINGS}:exported_objects.0.cuboid_dimensions", [9, 4, 2],
        "objects[0].cuboid.size: edges",
    ),
    "cuboid no box": (f"{OBJECT}.cuboid.3.0", 99.0, "objects[0].cuboid: no box"),
    "cuboid short": (f"{OBJECT}.cuboid", [[1, 2, 3]], "objects[0].cuboid: [[1, 2, 3]]"),
    "cuboid order": (f"{OBJECT}.cuboid", lambda corners: corners[::-1], "objects[0]."),
    "centroid": (f"{OBJECT}.cuboid_centroid", [0, 0, 40], "objects[0].cuboid_centroid: "),
    "projection": (f"{OBJECT}.projected_cuboid.0.0", 0.0, "objects[0].projected_cuboid: "),
    "projected centroid": (
        f"{OBJECT}.projected_cuboid_centroid", [0, 0], "objects[0].projected_cuboid_centroid: "
    ),
    "pose transform": (
        f"{OBJECT}.pose_transform.0.0", 5.0, "objects[0].pose_transform: no rotation"
    ),
    "pose transform place": (
        f"{OBJECT}.pose_transform.3.0", 5.0, "objects[0].pose_transform: translation"
    ),
    "visibility": (f"{OBJECT}.visibility", 4, "objects[0].visibility: 4"),
    "visibility of words": (f"{OBJECT}.visibility", "much", "objects[0].visibility: 'much'"),
    "bounding box": (
        f"{OBJECT}.bounding_box", {"top_left": [0, 0], "bottom_right": [9, 9]},
        "objects[0].bounding_box: (0, 0)–(9, 9) does not hold",
    ),
    "bounding box turned": (
        f"{OBJECT}.bounding_box", {"top_left": [9, 9], "bottom_right": [0, 0]},
        "objects[0].bounding_box: top_left",
    ),
    "bounding box order": (
        f"{OBJECT}.bounding_box", flip_box, "objects[0].bounding_box: column, row; 5 objects"
    ),
    "mask of another": ("000000.json:objects", other_masks, "objects[0].box: seen at"),
    "ids twice": (f"{OBJECT}.segmentation_id", 2, "objects.segmentation_id: 2 twice"),
    "instances twice": (f"{OBJECT}.instance_id", 2, "objects.instance_id: 2 twice"),
    "principal point": (f"{CAMERA}.intrinsics.cx", 999, "camera_data.intrinsics: K with"),
    "focal length": (f"{CAMERA}.intrinsics.fx", -150, "camera_data.intrinsics: K with"),
    "aspect": (f"{CAMERA}.intrinsics.fx", 450, "camera_data.intrinsics: "),
    "size": (f"{CAMERA}.width", 640, "camera_data.size: 640×128; the image has 128×128"),
    "settings cut": (SETTINGS, cut, f"{SETTINGS}: JSON"),
    "settings class": (
        f"{SETTINGS}:exported_objects.1", None,
        f"{SETTINGS}: exported_objects: no entry for class 'brick'",
    ),
}  # fmt: skip

REFUSED = {
    "image cut", "depth size", "seg size", "annotation cut", "annotation deep",
    "annotation list", "no objects", "object no record", "key twice", "class of number",
    "zero rotation", "short rotation", "no location", "location of words", "cuboid short",
    "visibility", "visibility of words", "settings cut",
}  # fmt: skip
"""What the source cannot read: it raises what the check collects, by the same parser."""


def spoil(root: Path, spoilt: Any, place: str, value: Any) -> None:
    """Spoil a file, or after a colon a value in it."""
    file, _, keys = place.partition(":")
    content = spoilt((root / file).read_bytes(), keys, value)
    (root / file).unlink() if content is None else (root / file).write_bytes(content)


@pytest.mark.parametrize("name", DAMAGES)
def test_every_damage_is_found_with_file_and_field(
    ndds, name, spoilt, assert_found, assert_refused
):
    *damage, expected = DAMAGES[name]
    spoil(ndds, spoilt, *damage)
    assert_found(ndds, expected)
    if name in REFUSED:
        assert_refused(lambda: NddsReader(ndds, PARTS), expected)


def test_one_defect_hides_no_other(ndds, spoilt, assert_found):
    # Without a location, the projection has nothing to be held against.
    names = (
        "image cut", "depth missing", "seg size", "NaN", "unknown class", "no rotation",
        "visibility", "size", "settings class", "pose transform",
    )  # fmt: skip
    for name in (*names, "projection"):
        *damage, _ = DAMAGES[name]
        spoil(ndds, spoilt, *damage)
    assert_found(ndds, *(DAMAGES[name][2] for name in names))


@pytest.mark.parametrize(
    ("field", "change", "note"),
    [("quaternion_xyzw", roll, "w, x, y, z"), ("bounding_box", flip_box, "column, row")],
)
def test_habits_of_a_whole_set_are_notes(ndds, field, change, note, spoilt):
    for path in ndds.glob("0*.json"):
        for number in (0, 1):
            spoil(ndds, spoilt, f"{path.name}:objects.{number}.{field}", change)
    report = check_dataset(ndds)
    assert report.defects == []
    assert report.notes == [f"{field}: {note} (6 objects)"]


def test_opengl_files_without_cuboids_are_clean(ndds):
    """As old nvisii writes them: y up, z backwards, projections and nothing in 3-D."""
    (ndds / "_object_settings.json").unlink()
    for path in ndds.glob("0*.json"):
        content = json.loads(path.read_text())
        for entry in content["objects"]:
            x, y, z = entry["location"]
            entry["location"] = [x / 100, -y / 100, -z / 100]
            rotation = (
                np.diag([1, -1, -1]) @ Rotation.from_quat(entry["quaternion_xyzw"]).as_matrix()
            )
            entry["quaternion_xyzw"] = Rotation.from_matrix(rotation).as_quat().tolist()
            entry["projected_cuboid"].append(entry.pop("projected_cuboid_centroid"))
            for field in ("cuboid", "cuboid_centroid", "pose_transform", "bounding_box"):
                del entry[field]
        path.write_text(json.dumps(content))
    report = check_dataset(ndds)
    assert report.defects == []
    assert report.notes == ["camera axes: OpenGL (6 objects)"]


def test_what_nobody_sees_may_be_behind_the_camera(ndds, spoilt):
    spoil(ndds, spoilt, f"{OBJECT}.visibility", 0)
    spoil(ndds, spoilt, f"{OBJECT}.location.2", lambda z: -z)
    for field in ("cuboid", "cuboid_centroid", "pose_transform", "projected_cuboid"):
        spoil(ndds, spoilt, f"{OBJECT}.{field}", None)
    assert check_dataset(ndds).defects == []
