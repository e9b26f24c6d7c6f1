"""NDDS: round trips, and files of other writers (synthesised with SciPy and OpenCV)."""

import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.data.formats.ndds.ndds_reader import NddsReader
from dopepp.data.formats.ndds.ndds_writer import NddsWriter
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.parts.part import Mesh, Part, make_part
from tests.data.makers import edit_json, pose_at, write_set

WIDTH, HEIGHT = 160, 120
K = camera_matrix(180.0, 181.0, 79.0, 60.5)
SIGNS = np.array([(x, y, z) for z in (1, -1) for x, y in ((1, -1), (-1, -1), (-1, 1), (1, 1))])
"""NDDS's corner order, from the readme of Falling Things."""


def make_box(name: str, sides: tuple[float, float, float], centre: tuple[float, ...]) -> Part:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    vertices = np.array(centre) + corners * np.array(sides) / 2
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]])
    return make_part(name, Mesh(vertices, faces.astype(np.int32)), points=vertices)


BOX = make_box("box", (0.08, 0.05, 0.03), (0.01, -0.02, 0.005))
CUBE = make_box("cube", (0.06, 0.06, 0.06), (0.0, 0.0, 0.0))


def random_pose(rng: np.random.Generator) -> np.ndarray:
    place = [*rng.uniform(-0.04, 0.04, 2), rng.uniform(0.35, 0.6)]
    return make_transform(Rotation.random(rng=rng).as_matrix(), np.array(place))


@pytest.fixture
def written(tmp_path, boxes):
    parts, samples = boxes
    return write_set(NddsWriter, tmp_path / "set", parts, samples), parts, samples


def test_keys_and_shares(written):
    root, parts, _ = written
    source = NddsReader(root, parts)
    assert (source.sample(1).key, source.sample(1).source) == ("000001", "ndds/set")
    shares = [NddsReader(root, parts, part_of=part) for part in ((0, 0.7), (0.7, 1))]
    assert shares[0].items + shares[1].items == source.items
    assert shares[0].describe()[0].identity["items"] != shares[1].describe()[0].identity["items"]


def test_fields_agree_with_their_documentation(written):
    root, (part, _), samples = written
    record = json.loads((root / "000001.json").read_text())
    P = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]])
    half, centre = np.ptp(part.cuboid, axis=0) / 2, part.cuboid[8]
    for item, instance in zip(record["objects"], samples[1].instances, strict=True):
        R, t = instance.T_cam_obj[:3, :3], instance.T_cam_obj[:3, 3]
        turned = Rotation.from_quat(item["quaternion_xyzw"]).as_matrix()
        np.testing.assert_allclose(turned, R, atol=1e-12)
        np.testing.assert_allclose(item["location"], 100 * t, atol=1e-10)
        # The readme of Falling Things: the rotation is Aᵀ·P of the stored matrix A.
        A = np.array(item["pose_transform"])
        np.testing.assert_allclose(A[:3, :3].T @ P, R, atol=1e-12)
        np.testing.assert_allclose(A[3], [*(100 * t), 1], atol=1e-10)
        corners = 100 * ((centre + SIGNS * half) @ R.T + t)
        np.testing.assert_allclose(item["cuboid"], corners, atol=1e-9)
        np.testing.assert_allclose(item["cuboid_centroid"], 100 * (R @ centre + t), atol=1e-9)
        pixels, _ = cv2.projectPoints(corners, np.zeros(3), np.zeros(3), samples[1].K, None)
        np.testing.assert_allclose(item["projected_cuboid"], pixels[:, 0], atol=1e-6)
        x, y, width, height = cv2.boundingRect(instance.mask.astype(np.uint8))
        assert item["bounding_box"]["top_left"] == [y, x]
        assert item["bounding_box"]["bottom_right"] == [y + height - 1, x + width - 1]
    camera = json.loads((root / "_camera_settings.json").read_text())["camera_settings"][0]
    assert camera["intrinsic_settings"]["fx"] == 150.0
    assert camera["captured_image_size"] == {"width": 128, "height": 128}
    exported = json.loads((root / "_object_settings.json").read_text())["exported_objects"]
    np.testing.assert_allclose(exported[0]["cuboid_dimensions"], [6, 4, 2.4])


def test_settings_are_written_for_one_camera_only(tmp_path, boxes):
    parts, (first, second, _) = boxes
    other = replace(second, K=camera_matrix(200.0, 200.0, 79.0, 60.0))
    write_set(NddsWriter, tmp_path, parts, [first, other])
    assert not (tmp_path / "_camera_settings.json").exists()
    writer = NddsWriter(tmp_path, parts)
    writer.finalize(0, [0])
    assert (tmp_path / "_camera_settings.json").exists()
    writer.write(1_234_567, first)
    assert writer.written(1234) == {1_234_567}


def test_the_writer_rejects_folders_of_other_data(tmp_path, boxes):
    for _ in range(2):
        NddsWriter(tmp_path / "a", boxes[0]).prepare()
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "holiday.jpg").touch()
    for folder, parts, message in (
        ("a", boxes[0][:1], r"_object_settings\.json of other parts"),
        ("b", boxes[0], r"holiday\.jpg in .*/b, which is not from an NDDS writer"),
    ):
        with pytest.raises(UserError, match=message):
            NddsWriter(tmp_path / folder, parts).prepare()


def test_samples_without_masks_depth_or_instances(tmp_path, boxes):
    parts, (first, second, _) = boxes
    bare = replace(first, depth=None, instances=[replace(first.instances[0], mask=None)])
    write_set(NddsWriter, tmp_path, parts, [bare, replace(second, instances=[])])
    read, empty = (NddsReader(tmp_path, parts).sample(index) for index in (0, 1))
    assert (read.depth, read.instances[0].mask, empty.instances) == (None, None, [])


def test_a_corner_behind_the_camera_is_written_finitely(tmp_path, boxes):
    (part, _), (sample, *others) = boxes
    first, second = sample.instances
    T = make_transform(first.T_cam_obj[:3, :3], np.array([0, 0, 0.02]))
    keypoints = project_keypoints(part.cuboid, T, sample.K)
    assert np.isnan(keypoints).any()
    near = replace(first, T_cam_obj=T, keypoints=keypoints)
    write_set(NddsWriter, tmp_path, boxes[0], [replace(sample, instances=[near, second]), *others])
    back = NddsReader(tmp_path, boxes[0]).sample(0).instances[0]
    np.testing.assert_allclose(back.T_cam_obj, T, atol=1e-12)
    np.testing.assert_allclose(back.keypoints, keypoints, atol=1e-6)


@dataclass
class ForeignWriter:
    """Writes NDDS in the conventions of other tools, without dopepp's writer."""

    root: Path
    order: str = "xyzw"
    unit: str = "cm"
    opengl: bool = False
    names: str = "{:06d}"
    suffix: str = ".png"
    own_camera: bool = True
    nine: bool = False
    noise: float = 0.0
    fixed: np.ndarray | None = None  # rigid 4×4, mesh to object frame, metres
    front_x: bool = False
    visibility: float | None = 1

    def __post_init__(self) -> None:
        self.poses: dict[str, list[np.ndarray]] = {}
        self.scale = {"cm": 100.0, "m": 1.0, "mm": 1000.0}[self.unit]
        self.F = np.eye(4) if self.fixed is None else self.fixed
        self.rng = np.random.default_rng(0)
        self.root.mkdir(parents=True, exist_ok=True)

    def items(self, count: int, *parts: Part) -> list[Path]:
        return [self.item(number, *parts) for number in range(count)]

    def item(
        self, number: int, *parts: Part, label: str | None = None, pose: np.ndarray | None = None
    ) -> Path:
        stem = self.names.format(number)
        objects = []
        for part in parts:
            T = random_pose(self.rng) if pose is None else pose
            self.poses.setdefault(stem, []).append(T)
            objects.append(self.object(part, T, label or part.name))
        camera: dict[str, Any] = {"location_worldframe": [1, 2, 3]}
        if self.own_camera:
            camera["intrinsics"] = {"fx": 180.0, "fy": 181.0, "cx": 79.0, "cy": 60.5}
        path = self.root / f"{stem}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"camera_data": camera, "objects": objects}))
        image = self.rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        cv2.imwrite(str(self.root / f"{stem}{self.suffix}"), image)
        return path

    def object(self, part: Part, T: np.ndarray, label: str) -> dict[str, Any]:
        T_file = T @ np.linalg.inv(self.F)
        vertices = part.mesh.vertices @ self.F[:3, :3].T + self.F[:3, 3]
        A = np.eye(3)
        if self.front_x:  # corners as seen along x, with z up; the pose is the mesh's
            A = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
        turned = vertices @ A.T
        low, high = turned.min(axis=0), turned.max(axis=0)
        corners = ((low + high) / 2 + SIGNS * (high - low) / 2) @ A
        corners_cam = corners @ T_file[:3, :3].T + T_file[:3, 3]
        points = np.vstack([corners_cam, corners_cam.mean(axis=0)])
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, None)[0][:, 0]
        pixels = pixels + self.rng.normal(0, 1, pixels.shape) * self.noise
        D = np.diag([1.0, -1.0, -1.0]) if self.opengl else np.eye(3)
        quaternion = Rotation.from_matrix(D @ T_file[:3, :3]).as_quat()
        if self.order == "wxyz":
            quaternion = quaternion[[3, 0, 1, 2]]
        record = {
            "class": label,
            "location": (self.scale * (D @ T_file[:3, 3])).tolist(),
            "quaternion_xyzw": quaternion.tolist(),
            "projected_cuboid": pixels[: 9 if self.nine else 8].tolist(),
        }
        if not self.nine:
            record["projected_cuboid_centroid"] = pixels[8].tolist()
            record["cuboid_centroid"] = (self.scale * points[8]).tolist()
        if self.visibility is not None:
            record["visibility"] = self.visibility
        return record

    def settings(self, *labels: str, scale: float = 100.0) -> None:
        matrix = self.F.copy()
        matrix[:3, :3] *= scale
        matrix[:3, 3] *= self.scale
        stored = matrix.T.tolist()
        entries = [
            {"class": label, "segmentation_class_id": 12 * n, "fixed_model_transform": stored}
            for n, label in enumerate(labels, 1)
        ]
        content = {"exported_object_classes": list(labels), "exported_objects": entries}
        (self.root / "_object_settings.json").write_text(json.dumps(content))

    def cameras(self, *names: str) -> None:
        intrinsics = {"fx": 180, "fy": 181, "cx": 79, "cy": 60.5, "s": 0}
        intrinsics |= {"resX": WIDTH, "resY": HEIGHT}
        cameras = [{"name": name, "intrinsic_settings": intrinsics} for name in names]
        (self.root / "_camera_settings.json").write_text(json.dumps({"camera_settings": cameras}))


def assert_read(foreign: ForeignWriter, source: NddsReader, atol: float = 1e-6) -> None:
    for index in range(len(source)):
        sample = source.sample(index)
        for instance, T in zip(sample.instances, foreign.poses[sample.key], strict=True):
            np.testing.assert_allclose(instance.T_cam_obj, T, atol=atol)
            cuboid = {"box": BOX, "cube": CUBE}[instance.label].cuboid
            expected = cv2.projectPoints(cuboid, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, None)
            np.testing.assert_allclose(instance.keypoints, expected[0][:, 0], atol=0.01)


QUARTER = np.array([[0, -1, 0, 0.02], [0, 0, -1, 0.05], [1, 0, 0, -0.01], [0, 0, 0, 1.0]])
SLANTED = make_transform(
    Rotation.from_euler("xyz", [80, 23, -12], degrees=True).as_matrix(),
    np.array([0.013, -0.04, 0.02]),
)


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
@pytest.mark.parametrize("unit", ["cm", "m", "mm"])
@pytest.mark.parametrize(("convention", "frame"), [
    ({}, "mesh"),
    ({"opengl": True, "nine": True}, "mesh"),
    ({"front_x": True, "nine": True}, "mesh, front x"),
    ({"front_x": True, "nine": True, "opengl": True}, "mesh, front x"),
    ({"fixed": QUARTER}, "fixed"),
    ({"fixed": SLANTED}, "fixed"),
], ids=["plain", "opengl", "nvisii", "old-nvisii", "fixed", "fixed-slanted"])  # fmt: skip
def test_every_convention_is_determined(tmp_path, order, unit, convention, frame, caplog):
    foreign = ForeignWriter(tmp_path, order=order, unit=unit, **convention)
    foreign.items(3, BOX, CUBE)
    if "fixed" in convention:
        foreign.settings("box", "cube")
    with caplog.at_level(logging.INFO):
        source = NddsReader(tmp_path, [BOX, CUBE])
    assert_read(foreign, source)
    result = source.finding.convention
    expected = (order, unit, "opengl" if convention.get("opengl") else "opencv", frame)
    assert (result.quaternion, result.unit, result.camera, result.frame) == expected
    assert f"quaternion {','.join(order)}, lengths in {unit}" in caplog.text
    (info,) = source.describe()
    assert str(result) == info.identity["convention"]


@given(seed=st.integers(0, 2**32 - 1), order=st.sampled_from(["xyzw", "wxyz"]))
def test_a_single_instance_is_enough(tmp_path_factory, seed, order):
    foreign = ForeignWriter(tmp_path_factory.mktemp("one"), order=order)
    foreign.rng = np.random.default_rng(seed)
    foreign.item(0, CUBE)
    assert_read(foreign, NddsReader(foreign.root, [CUBE]))


def test_falling_things(tmp_path):
    """FAT's folders, names, two cameras, classes with _16k, segmentation and depth."""
    foreign = ForeignWriter(
        tmp_path / "mixed" / "kitchen_0",
        names="{:06d}.left", suffix=".jpg", own_camera=False, fixed=SLANTED, visibility=0.75,
    )  # fmt: skip
    for number in range(3):
        foreign.item(number, BOX, label="box_16k")
        stem = f"{number:06d}.left"
        seg = np.zeros((HEIGHT, WIDTH), np.uint8)
        seg[20:60, 30:90] = 12
        cv2.imwrite(str(foreign.root / f"{stem}.seg.png"), seg)
        cv2.imwrite(str(foreign.root / f"{stem}.depth.png"), np.full_like(seg, 5000, np.uint16))
    foreign.settings("box_16k")
    foreign.cameras("left", "right")
    source = NddsReader(tmp_path, [BOX])
    sample = source.sample(1)
    (instance,) = sample.instances
    assert (sample.key, instance.label) == ("mixed/kitchen_0/000001.left", "box")
    np.testing.assert_allclose(instance.T_cam_obj, foreign.poses["000001.left"][0], atol=1e-6)
    assert instance.mask.sum() == 40 * 60
    assert instance.visible_fraction == pytest.approx(0.75)
    np.testing.assert_allclose(sample.depth, 0.5)
    assert NddsReader(tmp_path, [BOX], read_depth=False).sample(0).depth is None


def test_meshes_centred_at_their_box(tmp_path):
    """Poses refer to the mesh with its box's centre at the origin, which no field states."""
    foreign = ForeignWriter(tmp_path, fixed=pose_at(*-BOX.cuboid[8]), unit="m")
    foreign.items(4, BOX)
    source = NddsReader(tmp_path, [BOX])
    assert source.finding.convention.frame == "centred"
    assert_read(foreign, source)


def test_noise_in_the_projections(tmp_path):
    foreign = ForeignWriter(tmp_path, order="wxyz", noise=1.5)
    foreign.items(20, BOX, CUBE)
    source = NddsReader(tmp_path, [BOX, CUBE])
    assert source.finding.convention.quaternion == "wxyz"
    assert 0.5 < source.finding.error_px < 3
    assert_read(foreign, source)


def test_indistinguishable_orders_are_accepted(tmp_path):
    foreign, turn = ForeignWriter(tmp_path), Rotation.from_quat([0.5, 0.5, 0.5, 0.5])
    foreign.item(0, BOX, pose=make_transform(turn.as_matrix(), np.array([0.01, 0.0, 0.4])))
    source = NddsReader(tmp_path, [BOX])
    assert_read(foreign, source)


def test_an_item_with_another_convention_is_rejected(tmp_path):
    def roll(record):
        quaternion = record["objects"][0]["quaternion_xyzw"]
        quaternion.insert(0, quaternion.pop())

    edit_json(ForeignWriter(tmp_path).items(12, BOX)[7], roll)
    source = NddsReader(tmp_path, [BOX])
    source.sample(6)
    with pytest.raises(UserError, match=r"000007\.json: objects\[0\]\.projected_cuboid: .* px"):
        source.sample(7)


def test_no_convention_fits(tmp_path):
    ForeignWriter(tmp_path).items(4, BOX)
    inch = make_box("box", (0.2, 0.127, 0.076), (0.025, -0.05, 0.0127))
    with pytest.raises(UserError, match=r"no known convention fits.* px: quaternion .*, lengths"):
        NddsReader(tmp_path, [inch])


@pytest.mark.parametrize(("visibility", "share"), [(1, 1), (0.5, 0.5), (-1, 1), (None, 1)])
def test_visible_fraction_of_a_truncated_object(visibility, share, tmp_path):
    # The centre of the face towards the camera is on the left border.
    T = pose_at((-0.5 - 79.0) / 180 * 0.4 - BOX.cuboid[8, 0], 0, 0.4)
    ForeignWriter(tmp_path, visibility=visibility).item(0, BOX, pose=T)
    (instance,) = NddsReader(tmp_path, [BOX]).sample(0).instances
    assert instance.visible_fraction == pytest.approx(0.5 * share, abs=0.05)


def test_other_classes_and_hidden_objects_are_ignored_and_counted(tmp_path):
    def behind(record):
        record["objects"][0]["location"][2] *= -1
        record["objects"][0]["visibility"] = 0

    edit_json(ForeignWriter(tmp_path).items(3, BOX, CUBE)[2], behind)
    source = NddsReader(tmp_path, [BOX])
    (info,) = source.describe()
    assert info.num_instances == {"box": 2}
    assert info.identity["left out"] == {"box, behind the camera": 1, "cube": 3}
    assert [[i.label for i in source.sample(n).instances] for n in (0, 2)] == [["box"], []]
    assert (source.contains("box"), source.contains("cube")) == (True, False)
    dice = make_box("dice", (0.06,) * 3, (0.0,) * 3)
    renamed = NddsReader(tmp_path, [dice], classes={"cube": "dice"})
    assert [i.label for i in renamed.sample(0).instances] == ["dice"]
    for part, classes, message in (
        (BOX, {"cube": "dice"}, r"classes of the parts \['dice'\]"),
        (dice, None, r"of the parts dice.*other classes: .*box \(3\)"),
    ):
        with pytest.raises(UserError, match=message):
            NddsReader(tmp_path, [part], classes=classes)


def test_missing_camera_images_and_folders(tmp_path, caplog):
    def refused(message, folder=tmp_path / "set"):
        with pytest.raises(UserError, match=message):
            NddsReader(folder, [BOX])

    foreign = ForeignWriter(tmp_path / "set", own_camera=False)
    foreign.item(0, BOX)
    refused(r"camera_data\.intrinsics: 0 cameras.*_camera_settings")
    foreign.cameras("one", "two")
    refused(r"camera_data\.intrinsics: 2 cameras")
    foreign.cameras("one")
    foreign.item(1, BOX)
    (foreign.root / "000001.png").unlink()
    with caplog.at_level(logging.WARNING):
        assert len(NddsReader(foreign.root, [BOX])) == 1
    assert "ignoring 1 annotations without an image" in caplog.text
    refused("without an annotated image", tmp_path / "nowhere")
    (foreign.root / "000000.png").unlink()
    refused("without an annotated image", tmp_path)


def test_image_of_another_size_than_its_camera(tmp_path):
    ForeignWriter(tmp_path).item(0, BOX)
    cv2.imwrite(str(tmp_path / "000000.png"), np.zeros((40, 50, 3), np.uint8))
    with pytest.raises(UserError, match=r"for the 50×40 image of .*000000\.json"):
        NddsReader(tmp_path, [BOX]).sample(0)


def test_objects_that_share_a_label_have_no_mask(tmp_path):
    foreign = ForeignWriter(tmp_path)
    foreign.item(0, BOX, BOX)
    foreign.settings("box")
    cv2.imwrite(str(tmp_path / "000000.seg.png"), np.full((HEIGHT, WIDTH), 12, np.uint8))
    assert all(i.mask is None for i in NddsReader(tmp_path, [BOX]).sample(0).instances)
