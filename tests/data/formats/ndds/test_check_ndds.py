"""``dopepp check`` on NDDS: good folders are clean, each damage is found, habits are noted."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.data.check import check_dataset
from dopepp.data.formats.ndds.source import NddsSource
from dopepp.data.formats.ndds.writer import NddsWriter
from dopepp.data.formats.problems import CheckReport
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
def ndds(tmp_path: Path) -> Path:
    writer = NddsWriter(tmp_path / "ndds", PARTS)
    writer.prepare()
    for index in range(NUM_IMAGES):
        writer.write(index, make_sample(index))
    writer.finalize(0, range(NUM_IMAGES))
    return tmp_path / "ndds"


def found(report: CheckReport) -> list[str]:
    return [str(defect) for defect in report.defects]


def test_a_good_folder_is_clean(ndds: Path) -> None:
    report = check_dataset(ndds)
    assert (report.layout, report.num_images, found(report)) == ("NDDS", NUM_IMAGES, [])
    assert report.notes == []


Damage = Callable[[Path], Any]


def edit(change: Callable[[dict[str, Any]], Any], name: str = "000000.json") -> Damage:
    def damage(root: Path) -> None:
        content = json.loads((root / name).read_text())
        change(content)
        (root / name).write_text(json.dumps(content))

    return damage


def item(change: Callable[[dict[str, Any]], Any], number: int = 0) -> Damage:
    return edit(lambda content: change(content["objects"][number]))


def put(field: str, value: Any) -> Damage:
    return item(lambda entry: entry.__setitem__(field, value))


def scale(field: str, by: float) -> Damage:
    return item(lambda entry: entry.__setitem__(field, (by * np.array(entry[field])).tolist()))


def cut(name: str) -> Damage:
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[:-200])


def image(name: str, pixels: np.ndarray) -> Damage:
    return lambda root: cv2.imwrite(str(root / name), pixels)


def intrinsics(**values: float) -> Damage:
    return edit(lambda content: content["camera_data"]["intrinsics"].update(values))


def turn(entry: dict[str, Any]) -> None:
    rotation = Rotation.from_euler("xyz", [0.2, 0.3, 0.4]) * Rotation.from_quat(
        entry["quaternion_xyzw"]
    )
    entry["quaternion_xyzw"] = rotation.as_quat().tolist()


def rotate_order(entry: dict[str, Any]) -> None:
    entry["quaternion_xyzw"] = np.roll(entry["quaternion_xyzw"], 1).tolist()


def flip_box(entry: dict[str, Any]) -> None:
    entry["bounding_box"] = {name: corner[::-1] for name, corner in entry["bounding_box"].items()}


SMALL = np.zeros((SIZE // 2, SIZE), np.uint8)
DAMAGES: dict[str, tuple[Damage, str]] = {
    "image cut": (cut("000001.png"), "000001.png: image: unreadable"),
    "image missing": (lambda r: (r / "000001.png").unlink(), "000001.json: image: missing"),
    "depth cut": (
        lambda r: (r / "000001.depth.png").write_bytes(b"\x89PNG"),
        "000001.depth.png: image: of 4 bytes",
    ),
    "depth missing": (
        lambda r: (r / "000001.depth.png").unlink(), "000001.depth.png: file: missing"
    ),
    "depth size": (image("000001.depth.png", SMALL), "000001.depth.png: size: 128×64"),
    "seg missing": (lambda r: (r / "000001.seg.png").unlink(), "000001.seg.png: file: missing"),
    "seg size": (image("000001.seg.png", SMALL), "000001.seg.png: size"),
    "seg of nobody": (
        image("000001.seg.png", np.full((SIZE, SIZE), 9, np.uint8)),
        "000001.seg.png: values: [9]",
    ),
    "annotation missing": (
        lambda r: (r / "000001.json").unlink(), "000001.png: annotation: missing: no 000001.json"
    ),
    "annotation cut": (cut("000001.json"), "000001.json: JSON: line"),
    "annotation deep": (
        lambda r: (r / "000001.json").write_text("[" * 9999), "000001.json: JSON: brackets"
    ),
    "annotation list": (lambda r: (r / "000001.json").write_text("[]"), "000001.json: top level"),
    "no objects": (edit(lambda c: c.pop("objects")), "000000.json: objects: missing"),
    "object no record": (edit(lambda c: c["objects"].append(3)), "000000.json: objects[2]: 3"),
    "NaN": (
        edit(lambda c: c["objects"][0].__setitem__("location", [float("nan"), 0, 40])),
        "objects[0].location: not finite",
    ),
    "key twice": (
        lambda r: (r / "000001.json").write_text('{"objects": [], "objects": []}'),
        "000001.json: JSON: key 'objects' twice",
    ),
    "unknown class": (put("class", "ball"), "objects[0].class: unknown object 'ball'"),
    "class of number": (put("class", 5), "objects[0].class: 5"),
    "no rotation": (scale("quaternion_xyzw", 1.1), "objects[0].quaternion_xyzw: no rotation"),
    "zero rotation": (scale("quaternion_xyzw", 0), "objects[0].quaternion_xyzw: no rotation"),
    "short rotation": (put("quaternion_xyzw", [1, 0]), "objects[0].quaternion_xyzw: [1, 0]"),
    "no location": (item(lambda e: e.pop("location")), "objects[0].location: missing"),
    "location of words": (put("location", ["a", "b", "c"]), "objects[0].location: ['a'"),
    "another rotation": (
        item(turn), "objects[0].quaternion_xyzw: not the cuboid's orientation"
    ),
    "another order": (item(rotate_order), "objects[0].quaternion_xyzw: w, x, y, z; 5 objects"),
    "behind": (put("location", [0, 0, -40]), "objects[0].location.z: behind the camera"),
    "metres": (scale("location", 0.01), "objects[0].location.unit: "),
    "millimetres": (scale("location", 10), "objects[0].location.unit: "),
    "cuboid in m": (
        item(lambda e: e.update(
            cuboid=(0.01 * np.array(e["cuboid"])).tolist(),
            location=(0.01 * np.array(e["location"])).tolist(),
            cuboid_centroid=(0.01 * np.array(e["cuboid_centroid"])).tolist(),
        )),
        "objects[0].cuboid.unit: edges",
    ),
    "cuboid of another": (
        edit(
            lambda c: c["exported_objects"][0].__setitem__("cuboid_dimensions", [9, 4, 2]),
            "_object_settings.json",
        ),
        "objects[0].cuboid.size: edges",
    ),
    "cuboid no box": (
        item(lambda e: e["cuboid"][3].__setitem__(0, 99.0)), "objects[0].cuboid: no box"
    ),
    "cuboid short": (put("cuboid", [[1, 2, 3]]), "objects[0].cuboid: [[1, 2, 3]]"),
    "cuboid order": (item(lambda e: e["cuboid"].reverse()), "objects[0]."),
    "centroid": (put("cuboid_centroid", [0, 0, 40]), "objects[0].cuboid_centroid: "),
    "projection": (
        item(lambda e: e["projected_cuboid"][0].__setitem__(0, 0.0)),
        "objects[0].projected_cuboid: ",
    ),
    "projected centroid": (
        put("projected_cuboid_centroid", [0, 0]), "objects[0].projected_cuboid_centroid: "
    ),
    "pose transform": (
        item(lambda e: e["pose_transform"][0].__setitem__(0, 5.0)),
        "objects[0].pose_transform: no rotation",
    ),
    "pose transform place": (
        item(lambda e: e["pose_transform"][3].__setitem__(0, 5.0)),
        "objects[0].pose_transform: translation",
    ),
    "visibility": (put("visibility", 4), "objects[0].visibility: 4"),
    "visibility of words": (put("visibility", "much"), "objects[0].visibility: 'much'"),
    "bounding box": (
        put("bounding_box", {"top_left": [0, 0], "bottom_right": [9, 9]}),
        "objects[0].bounding_box: (0, 0)–(9, 9) does not hold",
    ),
    "bounding box turned": (
        put("bounding_box", {"top_left": [9, 9], "bottom_right": [0, 0]}),
        "objects[0].bounding_box: top_left",
    ),
    "bounding box order": (item(flip_box), "objects[0].bounding_box: column, row; 5 objects"),
    "mask of another": (
        edit(lambda c: [
            e.__setitem__("segmentation_id", 3 - e["segmentation_id"]) for e in c["objects"]
        ]),
        "objects[0].box: seen at",
    ),
    "ids twice": (put("segmentation_id", 2), "objects.segmentation_id: 2 twice"),
    "instances twice": (put("instance_id", 2), "objects.instance_id: 2 twice"),
    "principal point": (intrinsics(cx=999), "camera_data.intrinsics: K with"),
    "focal length": (intrinsics(fx=-150), "camera_data.intrinsics: K with"),
    "aspect": (intrinsics(fx=450), "camera_data.intrinsics: "),
    "size": (
        edit(lambda c: c["camera_data"].__setitem__("width", 640)),
        "camera_data.size: 640×128; the image has 128×128",
    ),
    "settings cut": (cut("_object_settings.json"), "_object_settings.json: JSON"),
    "settings class": (
        edit(lambda c: c["exported_objects"].pop(), "_object_settings.json"),
        "_object_settings.json: exported_objects: no entry for class 'brick'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_every_damage_is_found_with_file_and_field(
    ndds: Path, name: str, assert_found: Any
) -> None:
    damage, expected = DAMAGES[name]
    damage(ndds)
    assert_found(ndds, expected)


REFUSED = [
    "image cut", "depth size", "seg size", "annotation cut", "annotation deep",
    "annotation list", "no objects", "object no record", "key twice", "class of number",
    "zero rotation", "short rotation", "no location", "location of words", "cuboid short",
    "visibility", "visibility of words", "settings cut",
]  # fmt: skip
"""What the source cannot read: it raises what the check collects, by the same parser."""


@pytest.mark.parametrize("name", REFUSED)
def test_the_source_refuses_what_the_check_finds(
    ndds: Path, name: str, assert_refused: Any
) -> None:
    damage, expected = DAMAGES[name]
    damage(ndds)

    def read() -> None:
        source = NddsSource(ndds, PARTS)
        for index in range(len(source)):
            source.sample(index)

    assert_refused(read, expected)


def test_one_defect_hides_no_other(ndds: Path) -> None:
    names = [
        "image cut", "depth missing", "seg size", "NaN", "unknown class", "no rotation",
        "visibility", "projection", "size", "settings class", "pose transform",
    ]  # fmt: skip
    for name in names:
        DAMAGES[name][0](ndds)
    lines = found(check_dataset(ndds))
    # Without a location, the projection has nothing to be held against.
    for name in set(names) - {"projection"}:
        assert any(DAMAGES[name][1] in line for line in lines), (name, lines)


@pytest.mark.parametrize(
    ("change", "note"),
    [(rotate_order, "quaternion_xyzw: w, x, y, z"), (flip_box, "bounding_box: column, row")],
)
def test_habits_of_a_whole_set_are_notes(
    ndds: Path, change: Callable[[dict[str, Any]], None], note: str
) -> None:
    for path in ndds.glob("0*.json"):
        content = json.loads(path.read_text())
        for entry in content["objects"]:
            change(entry)
        path.write_text(json.dumps(content))
    report = check_dataset(ndds)
    assert found(report) == []
    assert report.notes == [f"{note} (6 objects)"]


def test_opengl_files_without_cuboids_are_clean(ndds: Path) -> None:
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
    assert found(report) == []
    assert report.notes == ["camera axes: OpenGL (6 objects)"]


def test_what_nobody_sees_may_be_behind_the_camera(ndds: Path) -> None:
    def hide(entry: dict[str, Any]) -> None:
        entry["visibility"] = 0
        entry["location"][2] *= -1
        for field in ("cuboid", "cuboid_centroid", "pose_transform", "projected_cuboid"):
            entry.pop(field)

    item(hide)(ndds)
    assert found(check_dataset(ndds)) == []
