"""``dopepp check`` on BOP, scenewise and in shards: a good set is clean, each damage is found."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.data.check import check_dataset
from dopepp.data.formats.bop.source import BopSource
from dopepp.data.formats.problems import CheckReport
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.part import Part

SIZE = 128
K = [[150.0, 0.0, 64.0], [0.0, 150.0, 63.0], [0.0, 0.0, 1.0]]
SIDES = np.array([60.0, 40.0, 24.0])  # mm
NUM_IMAGES = 3


def hull_mask(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners, _ = cv2.projectPoints(signs * SIDES / 2, cv2.Rodrigues(R)[0], t, np.array(K), None)
    mask = np.zeros((SIZE, SIZE), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(corners[:, 0]).astype(np.int32)), 255)
    return mask


def bounds(mask: np.ndarray) -> list[int]:
    x, y, width, height = cv2.boundingRect(mask)
    return [x, y, width - 1, height - 1]


def records(image: int) -> dict[str, Any]:
    """One image's camera, gt, gt_info and masks, with two objects, the second in front."""
    rng = np.random.default_rng(image)
    poses = [
        (Rotation.random(rng=rng).as_matrix(), np.array([x, 5.0 * image, 400.0 - 60 * n]))
        for n, x in enumerate((-30.0, 20.0))
    ]
    wholes = [hull_mask(R, t) for R, t in poses]
    visible = [np.where(wholes[1] > 0, 0, wholes[0]).astype(np.uint8), wholes[1]]
    infos = [
        {
            "bbox_obj": bounds(whole),
            "bbox_visib": bounds(seen),
            "px_count_all": int((whole > 0).sum()),
            "px_count_valid": int((whole > 0).sum()),
            "px_count_visib": int((seen > 0).sum()),
            "visib_fract": float((seen > 0).sum() / (whole > 0).sum()),
        }
        for whole, seen in zip(wholes, visible, strict=True)
    ]
    truths = [
        {"cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": t.tolist(), "obj_id": n + 1}
        for n, (R, t) in enumerate(poses)
    ]
    return {
        "camera": {"cam_K": np.ravel(K).tolist(), "depth_scale": 0.1},
        "gt": truths,
        "gt_info": infos,
        "mask": wholes,
        "mask_visib": visible,
    }


def models() -> dict[str, Any]:
    entry = {"diameter": float(np.linalg.norm(SIDES))}
    entry |= {f"min_{a}": -s / 2 for a, s in zip("xyz", SIDES.tolist(), strict=True)}
    entry |= {f"size_{a}": s for a, s in zip("xyz", SIDES.tolist(), strict=True)}
    turn = np.diag([-1.0, -1.0, 1.0, 1.0]).ravel().tolist()
    axis = {"axis": [0, 0, 1], "offset": [0, 0, 0]}
    return {
        "1": entry | {"symmetries_discrete": [turn]},
        "2": entry | {"symmetries_continuous": [axis]},
    }


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def picture(image: int) -> np.ndarray:
    return np.random.default_rng(image).integers(0, 255, (SIZE, SIZE, 3), np.uint8)


def depth() -> np.ndarray:
    return np.full((SIZE, SIZE), 4000, np.uint16)


def write_models(root: Path) -> None:
    (root / "models").mkdir(parents=True)
    (root / "models" / "models_info.json").write_text(json.dumps(models()))
    for number in (1, 2):
        (root / "models" / f"obj_{number:06d}.ply").write_bytes(b"ply\n")


@pytest.fixture
def bop(tmp_path: Path) -> Path:
    root = tmp_path / "bop"
    write_models(root)
    scene = root / "train_pbr" / "000000"
    for folder in ("rgb", "depth", "mask", "mask_visib"):
        (scene / folder).mkdir(parents=True)
    merged: dict[str, dict[str, Any]] = {"camera": {}, "gt": {}, "gt_info": {}}
    for image in range(NUM_IMAGES):
        parts = records(image)
        (scene / "rgb" / f"{image:06d}.png").write_bytes(png(picture(image)))
        (scene / "depth" / f"{image:06d}.png").write_bytes(png(depth()))
        for name in ("mask", "mask_visib"):
            for number, mask in enumerate(parts[name]):
                (scene / name / f"{image:06d}_{number:06d}.png").write_bytes(png(mask))
        for name, by_image in merged.items():
            by_image[str(image)] = parts[name]
    for name, by_image in merged.items():
        (scene / f"scene_{name}.json").write_text(json.dumps(by_image))
    return root


SCENE = "train_pbr/000000"


def found(report: CheckReport) -> list[str]:
    return [str(defect) for defect in report.defects]


def test_a_good_set_is_clean_from_any_level(bop: Path) -> None:
    for root in (bop, bop / "train_pbr", bop / SCENE):
        report = check_dataset(root)
        assert (report.layout, report.num_images, found(report)) == ("BOP", NUM_IMAGES, [])
        assert report.notes == []
        assert report.ok


def edit(name: str, change: Callable[[Any], None]) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        path = root / name
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return damage


def scene(what: str, change: Callable[[Any], None]) -> Callable[[Path], None]:
    return edit(f"{SCENE}/scene_{what}.json", change)


def put(*keys: Any, value: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value

    return change


def drop(*keys: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in keys[:-1]:
            content = content[key]
        del content[keys[-1]]

    return change


def scaled(*keys: Any, by: float) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in keys[:-1]:
            content = content[key]
        value = content[keys[-1]]
        content[keys[-1]] = [v * by for v in value] if isinstance(value, list) else value * by

    return change


def cut(name: str, share: float = 0.5) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        content = (root / name).read_bytes()
        (root / name).write_bytes(content[: int(len(content) * share)])

    return damage


def remove(name: str) -> Callable[[Path], None]:
    return lambda root: (root / name).unlink()


def replace(name: str, image: np.ndarray) -> Callable[[Path], None]:
    return lambda root: (root / name).write_bytes(png(image)) and None


def text(name: str, old: str, new: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        content = (root / name).read_text()
        assert old in content
        (root / name).write_text(content.replace(old, new, 1))

    return damage


SMALL = np.zeros((SIZE // 2, SIZE, 3), np.uint8)
DAMAGES: dict[str, tuple[Callable[[Path], None], str]] = {
    "rgb cut": (cut(f"{SCENE}/rgb/000001.png"), f"{SCENE}/rgb/000001.png: image: unreadable"),
    "rgb empty": (cut(f"{SCENE}/rgb/000001.png", 0), "rgb/000001.png: image: unreadable"),
    "rgb missing": (remove(f"{SCENE}/rgb/000001.png"), "rgb/000001.png: file: missing"),
    "depth cut": (cut(f"{SCENE}/depth/000002.png"), "depth/000002.png: image: unreadable"),
    "depth missing": (remove(f"{SCENE}/depth/000002.png"), "depth/000002.png: file: missing"),
    "depth size": (
        replace(f"{SCENE}/depth/000002.png", SMALL[..., 0]),
        "depth/000002.png: size: 128×64 pixels; allowed: 128×128",
    ),
    "depth colour": (
        replace(f"{SCENE}/depth/000002.png", np.zeros((SIZE, SIZE, 3), np.uint8)),
        "depth/000002.png: channels: ",
    ),
    "mask cut": (
        cut(f"{SCENE}/mask/000000_000001.png"), "mask/000000_000001.png: image: unreadable"
    ),
    "mask missing": (
        remove(f"{SCENE}/mask_visib/000000_000001.png"),
        "mask_visib/000000_000001.png: file: missing",
    ),
    "mask size": (
        replace(f"{SCENE}/mask_visib/000000_000000.png", SMALL[..., 0]),
        "mask_visib/000000_000000.png: size",
    ),
    "mask of no object": (
        replace(f"{SCENE}/mask/000000_000007.png", SMALL[..., 0]),
        "mask/000000_000007.png: file: no object 7",
    ),
    "mask of another": (
        replace(f"{SCENE}/mask_visib/000000_000001.png", np.eye(SIZE, dtype=np.uint8) * 255),
        "scene_gt.json: 0[1].mask_visib:",
    ),
    "gt missing": (remove(f"{SCENE}/scene_gt.json"), "scene_gt.json: file: missing"),
    "camera missing": (remove(f"{SCENE}/scene_camera.json"), "scene_camera.json: file: missing"),
    "gt cut": (cut(f"{SCENE}/scene_gt.json"), "scene_gt.json: JSON: line 1"),
    "gt NaN": (
        text(f"{SCENE}/scene_gt.json", '"obj_id": 1', '"obj_id": NaN'),
        "scene_gt.json: JSON: line 1",
    ),
    "gt deep": (
        lambda root: (root / SCENE / "scene_gt.json").write_text("[" * 5000 + "]" * 5000) and None,
        "scene_gt.json: JSON: brackets nested",
    ),
    "gt list": (
        lambda root: (root / SCENE / "scene_gt.json").write_text("[]") and None,
        "scene_gt.json: top level",
    ),
    "no gt": (scene("gt", drop("1")), "scene_gt.json: 1: missing"),
    "no camera": (scene("camera", drop("1")), "scene_camera.json: 1: missing"),
    "no info": (scene("gt_info", drop("1")), "scene_gt_info.json: 1: missing"),
    "one info less": (scene("gt_info", drop("1", 0)), "gt_info.json: 1: 1 objects; allowed: 2"),
    "duplicate image": (
        text(f"{SCENE}/scene_gt.json", '"1": [', '"01": [], "1": ['), "image 1 twice"
    ),
    "duplicate key": (
        text(f"{SCENE}/scene_gt.json", '"1": [', '"1": [], "1": ['), "JSON: key '1' twice"
    ),
    "no image's number": (scene("gt", put("x", value=[])), "'x': no image's number"),
    "rotation scaled": (
        scene("gt", scaled("0", 0, "cam_R_m2c", by=1.01)), "0[0].cam_R_m2c: no rotation"
    ),
    "rotation mirrored": (
        scene("gt", scaled("0", 0, "cam_R_m2c", by=-1)), "determinant -1"
    ),
    "rotation short": (
        scene("gt", put("0", 0, "cam_R_m2c", value=[1.0] * 8)), "0[0].cam_R_m2c: [1.0"
    ),
    "rotation gone": (scene("gt", drop("0", 0, "cam_R_m2c")), "0[0].cam_R_m2c: missing"),
    "rotation of words": (
        scene("gt", put("0", 0, "cam_R_m2c", value=["a"] * 9)), "0[0].cam_R_m2c: ['a'"
    ),
    "behind": (
        scene("gt", put("0", 1, "cam_t_m2c", value=[0.0, 0.0, -400.0])),
        "0[1].cam_t_m2c.z: behind the camera",
    ),
    "metres": (scene("gt", scaled("2", 0, "cam_t_m2c", by=0.001)), "2[0].cam_t_m2c.unit:"),
    "moved": (
        scene("gt", put("0", 1, "cam_t_m2c", value=[90.0, 0.0, 340.0])),
        "0[1].box: seen at",
    ),
    "too near": (scene("gt", scaled("0", 1, "cam_t_m2c", by=0.25)), "0[1].box: "),
    "unknown object": (scene("gt", put("0", 0, "obj_id", value=9)), "obj_id: unknown object 9"),
    "object of words": (scene("gt", put("0", 0, "obj_id", value="9")), "0[0].obj_id: '9'"),
    "huge number": (
        scene("gt", put("0", 0, "cam_t_m2c", value=[10**400, 0, 0])), "0[0].cam_t_m2c:"
    ),
    "object no record": (scene("gt", put("0", 0, value=5)), "0[0]: 5"),
    "focal length": (
        scene("camera", put("0", "cam_K", value=[-150.0, 0, 64, 0, 150, 63, 0, 0, 1])),
        "scene_camera.json: 0.cam_K:",
    ),
    "principal point": (
        scene("camera", put("0", "cam_K", value=[150.0, 0, 640, 0, 150, 63, 0, 0, 1])),
        "cx=640",
    ),
    "aspect": (
        scene("camera", put("0", "cam_K", value=[450.0, 0, 64, 0, 150, 63, 0, 0, 1])), "fx/fy = 3"
    ),
    "no pinhole": (scene("camera", put("0", "cam_K", value=[1.0] * 9)), "0.cam_K: K"),
    "K short": (scene("camera", put("0", "cam_K", value=[1.0])), "0.cam_K: [1.0]"),
    "depth scale": (scene("camera", put("0", "depth_scale", value=0)), "0.depth_scale: 0"),
    "no depth scale": (scene("camera", drop("0", "depth_scale")), "0.depth_scale: missing"),
    "fraction": (scene("gt_info", put("0", 0, "visib_fract", value=1.5)), "0[0].visib_fract: 1.5"),
    "fraction and counts": (
        scene("gt_info", put("0", 1, "visib_fract", value=0.2)), "0[1].visib_fract: 0.2, the pixel"
    ),
    "counts": (scene("gt_info", scaled("0", 1, "px_count_visib", by=1.5)), "0[1].px_count_visib"),
    "visible box": (
        scene("gt_info", put("0", 1, "bbox_visib", value=[0, 0, 20, 20])), "0[1].bbox_visib:"
    ),
    "box short": (scene("gt_info", put("0", 1, "bbox_obj", value=[0])), "0[1].bbox_obj: [0]"),
    "diameter in m": (
        edit("models/models_info.json", scaled("1", "diameter", by=0.001)), "1.unit: 0.0"
    ),
    "diameter and box": (
        edit("models/models_info.json", scaled("1", "diameter", by=2)), "1.diameter: 1"
    ),
    "symmetry": (
        edit("models/models_info.json", scaled("1", "symmetries_discrete", 0, by=2)),
        "1.symmetries_discrete[0]: no rotation",
    ),
    "axis": (
        edit("models/models_info.json", scaled("2", "symmetries_continuous", 0, "axis", by=0)),
        "2.symmetries_continuous[0].axis: zero",
    ),
    "model missing": (remove("models/obj_000002.ply"), "models/obj_000002.ply: file: missing"),
    "image without records": (
        replace(f"{SCENE}/rgb/000009.png", picture(9)), "scene_camera.json: 9: missing"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_every_damage_is_found_with_file_and_field(bop: Path, name: str, assert_found: Any) -> None:
    damage, expected = DAMAGES[name]
    damage(bop)
    assert_found(bop, expected)


REFUSED = [
    "rgb cut", "depth cut", "depth missing", "depth size", "depth colour",
    "mask size", "camera missing", "gt cut", "gt NaN", "gt deep", "gt list", "no info",
    "one info less", "duplicate key", "no image's number", "rotation scaled",
    "rotation mirrored", "rotation short", "rotation gone", "rotation of words",
    "object of words", "huge number", "object no record", "no pinhole",
    "K short", "depth scale", "fraction", "symmetry", "axis",
]  # fmt: skip
"""What the source cannot read: it raises what the check collects, by the same parser."""


@pytest.mark.parametrize("name", REFUSED)
def test_the_source_refuses_what_the_check_finds(bop: Path, name: str, assert_refused: Any) -> None:
    damage, expected = DAMAGES[name]
    damage(bop)
    cube = cuboid_keypoints(-SIDES / 2000, SIDES / 2000)
    parts = [Part(f"obj_{n:06d}", cube, 0.08, cube[:8]) for n in (1, 2)]

    def read() -> None:
        source = BopSource(bop, parts, "train_pbr")
        for index in range(len(source)):
            source.sample(index)

    expected = expected.replace("0.cam_K: K", "scene_camera.json: K ")
    assert_refused(read, expected if ": " in expected else f"{expected}: ")


INDEPENDENT = [
    "rgb cut", "depth missing", "mask cut", "rotation scaled", "behind", "metres", "no camera",
    "diameter and box", "model missing", "K short", "fraction",
]  # fmt: skip


def test_one_defect_hides_no_other(bop: Path) -> None:
    for name in INDEPENDENT:
        DAMAGES[name][0](bop)
    lines = found(check_dataset(bop))
    for name in INDEPENDENT:
        assert any(DAMAGES[name][1] in line for line in lines), (name, lines)


def test_a_number_that_is_not_finite_hides_nothing_in_its_file(bop: Path) -> None:
    DAMAGES["behind"][0](bop)
    DAMAGES["gt NaN"][0](bop)
    lines = found(check_dataset(bop))
    assert any("behind the camera" in line for line in lines)
    assert any("JSON: line 1" in line for line in lines)


def test_private_ground_truth_and_missing_models_are_notes(bop: Path) -> None:
    for name in ("scene_gt.json", "scene_gt_info.json"):
        (bop / SCENE / name).unlink()
    for folder in ("mask", "mask_visib"):
        for path in (bop / SCENE / folder).iterdir():
            path.unlink()
    (bop / "models" / "models_info.json").unlink()
    report = check_dataset(bop)
    assert report.ok
    assert any("has no scene_gt.json" in note for note in report.notes)
    assert any("models_info.json" in note for note in report.notes)


# --- shards ----------------------------------------------------------------------------------


def runs(mask: np.ndarray) -> dict[str, Any]:
    """COCO's uncompressed run lengths, column by column, counted one by one."""
    counts, value = [0], 0
    for pixel in (mask > 0).T.ravel().astype(int).tolist():
        if pixel != value:
            counts.append(0)
            value = pixel
        counts[-1] += 1
    return {"counts": counts, "size": list(mask.shape)}


def shard_members(image: int) -> dict[str, bytes]:
    parts = records(image)
    content = {"rgb.png": png(picture(image)), "depth.png": png(depth())}
    for name in ("camera", "gt", "gt_info"):
        content[f"{name}.json"] = json.dumps(parts[name]).encode()
    for name in ("mask", "mask_visib"):
        by_number = {str(n): runs(mask) for n, mask in enumerate(parts[name])}
        content[f"{name}.json"] = json.dumps(by_number).encode()
    return {f"000000_{image:06d}.{name}": data for name, data in content.items()}


def write_shard(path: Path, members: list[tuple[str, bytes]]) -> None:
    with tarfile.open(path, "w") as archive:
        for name, data in members:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))


@pytest.fixture
def shards(tmp_path: Path) -> Path:
    root = tmp_path / "wds"
    write_models(root)
    (root / "train_pbr").mkdir()
    keys = {f"000000_{image:06d}": 0 for image in range(NUM_IMAGES)}
    (root / "train_pbr" / "key_to_shard.json").write_text(json.dumps(keys))
    rewrite(root, lambda members: None)
    return root


def rewrite(root: Path, change: Callable[[dict[str, bytes]], Any]) -> None:
    members: dict[str, bytes] = {}
    for image in range(NUM_IMAGES):
        members |= shard_members(image)
    changed = change(members)
    listed = changed if isinstance(changed, list) else list(members.items())
    write_shard(root / "train_pbr" / "shard-000000.tar", listed)


def in_member(name: str, change: Callable[[Any], None]) -> Callable[[dict[str, bytes]], Any]:
    def damage(members: dict[str, bytes]) -> None:
        content = json.loads(members[name])
        change(content)
        members[name] = json.dumps(content).encode()

    return damage


FIRST = "000000_000000"
SHARD_DAMAGES: dict[str, tuple[Callable[[dict[str, bytes]], Any], str]] = {
    "image cut": (
        lambda m: m.update({f"{FIRST}.rgb.png": m[f"{FIRST}.rgb.png"][:900]}),
        f"shard-000000.tar/{FIRST}.rgb.png: image: unreadable",
    ),
    "no image": (lambda m: m.pop(f"{FIRST}.rgb.png") and None, f"{FIRST}.rgb.png: member: missing"),
    "no camera": (
        lambda m: m.pop(f"{FIRST}.camera.json") and None, f"{FIRST}.camera.json: member: missing"
    ),
    "depth size": (
        lambda m: m.update({f"{FIRST}.depth.png": png(SMALL[..., 0])}), f"{FIRST}.depth.png: size"
    ),
    "rotation": (
        in_member(f"{FIRST}.gt.json", scaled(0, "cam_R_m2c", by=1.1)),
        f"{FIRST}.gt.json: [0].cam_R_m2c: no rotation",
    ),
    "behind": (
        in_member(f"{FIRST}.gt.json", put(0, "cam_t_m2c", value=[0, 0, -1])),
        f"{FIRST}.gt.json: [0].cam_t_m2c.z: behind",
    ),
    "K": (
        in_member(f"{FIRST}.camera.json", put("cam_K", value=[150, 0, 640, 0, 150, 63, 0, 0, 1])),
        f"{FIRST}.camera.json: cam_K:",
    ),
    "runs": (
        in_member(f"{FIRST}.mask_visib.json", put("0", "counts", value=[5])),
        f"{FIRST}.mask_visib.json: 0: counts",
    ),
    "mask gone": (
        in_member(f"{FIRST}.mask_visib.json", drop("1")), f"{FIRST}.mask_visib.json: 1: missing"
    ),
    "json cut": (
        lambda m: m.update({f"{FIRST}.gt.json": m[f"{FIRST}.gt.json"][:90]}),
        f"{FIRST}.gt.json: JSON: ",
    ),
    "moved": (
        in_member(f"{FIRST}.gt.json", put(1, "cam_t_m2c", value=[90.0, 0.0, 340.0])), "[1].box: "
    ),
    "escape": (
        lambda m: [("../evil.rgb.png", b"x"), *m.items()], "archive: member '../evil.rgb.png'"
    ),
    "member twice": (
        lambda m: [*m.items(), (f"{FIRST}.gt.json", b"[]")], f"{FIRST}.gt.json' twice"
    ),
    "key not together": (
        lambda m: [*list(m.items())[1:], next(iter(m.items()))],
        f"{FIRST}: key: its members are not together",
    ),
    "key not listed": (
        lambda m: m.update({f"9_9.{n.partition('.')[2]}": d for n, d in shard_members(0).items()}),
        "key_to_shard.json: 9_9: missing",
    ),
}  # fmt: skip


def test_good_shards_are_clean(shards: Path) -> None:
    for root in (shards, shards / "train_pbr"):
        report = check_dataset(root)
        assert (report.layout, report.num_images) == ("BOP-WebDataset", NUM_IMAGES)
        assert found(report) == []


@pytest.mark.parametrize("name", SHARD_DAMAGES)
def test_every_damage_in_a_shard_is_found(shards: Path, name: str, assert_found: Any) -> None:
    damage, expected = SHARD_DAMAGES[name]
    rewrite(shards, damage)
    assert_found(shards, expected)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.97])
def test_shard_cut_short(shards: Path, share: float) -> None:
    cut("train_pbr/shard-000000.tar", share)(shards)
    lines = found(check_dataset(shards))
    assert any("shard-000000.tar: archive: " in line for line in lines), lines


def test_a_bad_archive_does_not_hide_what_it_holds(shards: Path) -> None:
    def damage(members: dict[str, bytes]) -> list[tuple[str, bytes]]:
        SHARD_DAMAGES["behind"][0](members)
        listed = list(members.items())
        return [*listed[:2], ("../evil.txt", b"x"), listed[0], *listed[2:]]

    rewrite(shards, damage)
    lines = found(check_dataset(shards))
    assert any("archive" in line for line in lines)
    assert any("behind the camera" in line for line in lines)
    assert any("twice" in line for line in lines)


def test_shard_that_is_no_archive(shards: Path) -> None:
    (shards / "train_pbr" / "shard-000001.tar").write_bytes(b"\x1f\x8b" + bytes(600))
    report = check_dataset(shards)
    assert report.num_images == NUM_IMAGES
    assert any("shard-000001.tar: archive" in line for line in found(report))
