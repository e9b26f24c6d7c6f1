"""``dopepp check`` on BOP, scenewise and in shards: a good set is clean, each damage is found."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dopepp.data.check import check_dataset
from dopepp.data.formats.bop.models import bop_parts
from dopepp.data.formats.bop.reader import BopReader
from dopepp.data.formats.webdataset.reader import WebdatasetReader
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
    infos, truths = [], []
    for number, ((R, t), whole, seen) in enumerate(zip(poses, wholes, visible, strict=True)):
        all_pixels, seen_pixels = int((whole > 0).sum()), int((seen > 0).sum())
        counts = {"all": all_pixels, "valid": all_pixels, "visib": seen_pixels}
        info = {"bbox_obj": bounds(whole), "bbox_visib": bounds(seen)}
        info |= {f"px_count_{name}": count for name, count in counts.items()}
        infos.append(info | {"visib_fract": seen_pixels / all_pixels})
        pose = {"cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": t.tolist()}
        truths.append(pose | {"obj_id": number + 1})
    camera = {"cam_K": np.ravel(K).tolist(), "depth_scale": 0.1}
    return {
        "camera": camera, "gt": truths, "gt_info": infos, "mask": wholes, "mask_visib": visible
    }  # fmt: skip


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
        trimesh.creation.box(SIDES).export(root / "models" / f"obj_{number:06d}.ply")


@pytest.fixture
def bop(tmp_path):
    root = tmp_path / "bop"
    write_models(root)
    scene = root / "train_pbr" / "000000"
    for folder in ("rgb", "depth", "mask", "mask_visib"):
        (scene / folder).mkdir(parents=True)
    merged = {"camera": {}, "gt": {}, "gt_info": {}}
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


def test_a_good_set_is_clean_from_any_level(bop):
    for root in (bop, bop / "train_pbr", bop / SCENE):
        report = check_dataset(root)
        assert (report.layout, report.num_images, report.defects) == ("BOP", NUM_IMAGES, [])
        assert report.notes == []
        assert report.ok


FILES = {name: f"{SCENE}/scene_{name}.json" for name in ("gt", "camera", "gt_info")}
FILES["models"] = "models/models_info.json"


def spoil(root: Path, spoilt: Any, place: str, value: Any) -> None:
    """Spoil a file, or after a colon a value in it; files of the scene need no folder."""
    file, _, keys = place.partition(":")
    path = root / FILES.get(file, file if file.startswith("models") else f"{SCENE}/{file}")
    content = spoilt(path.read_bytes() if path.exists() else b"", keys, value)
    path.unlink() if content is None else path.write_bytes(content)


def times(by: float) -> Callable[[Any], Any]:
    return lambda value: [v * by for v in value] if isinstance(value, list) else value * by


def instead(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda content: content.replace(old, new, 1)


def intrinsics(fx: float, cx: float) -> list[float]:
    return [fx, 0, cx, 0, 150, 63, 0, 0, 1]


def half(content: bytes) -> bytes:
    return content[: len(content) // 2]


SMALL = np.zeros((SIZE // 2, SIZE), np.uint8)
DAMAGES = {
    "rgb cut": ("rgb/000001.png", half, f"{SCENE}/rgb/000001.png: image: unreadable"),
    "rgb empty": ("rgb/000001.png", b"", "rgb/000001.png: image: unreadable"),
    "rgb missing": ("rgb/000001.png", None, "rgb/000001.png: file: missing"),
    "depth cut": ("depth/000002.png", half, "depth/000002.png: image: unreadable"),
    "depth missing": ("depth/000002.png", None, "depth/000002.png: file: missing"),
    "depth size": (
        "depth/000002.png", SMALL, "depth/000002.png: size: 128×64 pixels; allowed: 128×128"
    ),
    "depth colour": ("depth/000002.png", picture(9), "depth/000002.png: channels: "),
    "mask cut": ("mask/000000_000001.png", half, "mask/000000_000001.png: image: unreadable"),
    "mask missing": ("mask_visib/000000_000001.png", None, "000000_000001.png: file: missing"),
    "mask size": ("mask_visib/000000_000000.png", SMALL, "mask_visib/000000_000000.png: size"),
    "mask of no object": ("mask/000000_000007.png", SMALL, "000000_000007.png: file: no object 7"),
    "mask of another": (
        "mask_visib/000000_000001.png", np.eye(SIZE, dtype=np.uint8) * 255,
        "scene_gt.json: 0[1].mask_visib:",
    ),
    "gt missing": ("gt", None, "scene_gt.json: file: missing"),
    "camera missing": ("camera", None, "scene_camera.json: file: missing"),
    "gt cut": ("gt", half, "scene_gt.json: JSON: line 1"),
    "gt NaN": ("gt", instead(b'"obj_id": 1', b'"obj_id": NaN'), "scene_gt.json: JSON: line 1"),
    "gt deep": ("gt", b"[" * 5000 + b"]" * 5000, "scene_gt.json: JSON: brackets nested"),
    "gt list": ("gt", b"[]", "scene_gt.json: top level"),
    "no gt": ("gt:1", None, "scene_gt.json: 1: missing"),
    "no camera": ("camera:1", None, "scene_camera.json: 1: missing"),
    "one info less": ("gt_info:1.0", None, "gt_info.json: 1: 1 objects; allowed: 2"),
    "duplicate image": ("gt", instead(b'"1": [', b'"01": [], "1": ['), "image 1 twice"),
    "duplicate key": ("gt", instead(b'"1": [', b'"1": [], "1": ['), "JSON: key '1' twice"),
    "no image's number": ("gt:x", [], "'x': no image's number"),
    "rotation scaled": ("gt:0.0.cam_R_m2c", times(1.01), "0[0].cam_R_m2c: no rotation"),
    "rotation mirrored": ("gt:0.0.cam_R_m2c", times(-1), "determinant -1"),
    "rotation short": ("gt:0.0.cam_R_m2c", [1.0] * 8, "0[0].cam_R_m2c: [1.0"),
    "rotation gone": ("gt:0.0.cam_R_m2c", None, "0[0].cam_R_m2c: missing"),
    "rotation of words": ("gt:0.0.cam_R_m2c", ["a"] * 9, "0[0].cam_R_m2c: ['a'"),
    "behind": ("gt:0.1.cam_t_m2c", [0.0, 0.0, -400.0], "0[1].cam_t_m2c.z: behind the camera"),
    "metres": ("gt:2.0.cam_t_m2c", times(0.001), "2[0].cam_t_m2c.unit:"),
    "moved": ("gt:0.1.cam_t_m2c", [90.0, 0.0, 340.0], "0[1].box: seen at"),
    "too near": ("gt:0.1.cam_t_m2c", times(0.25), "0[1].box: "),
    "object of words": ("gt:0.0.obj_id", "9", "0[0].obj_id: '9'"),
    "huge number": ("gt:0.0.cam_t_m2c", [10**400, 0, 0], "0[0].cam_t_m2c:"),
    "object no record": ("gt:0.0", 5, "0[0]: 5"),
    "focal length": ("camera:0.cam_K", intrinsics(-150.0, 64), "scene_camera.json: 0.cam_K:"),
    "principal point": ("camera:0.cam_K", intrinsics(150.0, 640), "cx=640"),
    "aspect": ("camera:0.cam_K", intrinsics(450.0, 64), "fx/fy = 3"),
    "no pinhole": ("camera:0.cam_K", [1.0] * 9, "0.cam_K: K"),
    "K short": ("camera:0.cam_K", [1.0], "0.cam_K: [1.0]"),
    "depth scale": ("camera:0.depth_scale", 0, "0.depth_scale: 0"),
    "no depth scale": ("camera:0.depth_scale", None, "0.depth_scale: missing"),
    "fraction": ("gt_info:0.0.visib_fract", 1.5, "0[0].visib_fract: 1.5"),
    "fraction and counts": ("gt_info:0.1.visib_fract", 0.2, "0[1].visib_fract: 0.2, the pixel"),
    "counts": ("gt_info:0.1.px_count_visib", times(1.5), "0[1].px_count_visib"),
    "visible box": ("gt_info:0.1.bbox_visib", [0, 0, 20, 20], "0[1].bbox_visib:"),
    "box short": ("gt_info:0.1.bbox_obj", [0], "0[1].bbox_obj: [0]"),
    "diameter in m": ("models:1.diameter", times(0.001), "1.unit: 0.0"),
    "diameter and box": ("models:1.diameter", times(2), "1.diameter: 1"),
    "symmetry": (
        "models:1.symmetries_discrete.0", times(2), "1.symmetries_discrete[0]: no rotation"
    ),
    "axis": ("models:2.symmetries_continuous.0.axis", times(0), "continuous[0].axis: zero"),
    "model cut": ("models/obj_000002.ply", b"ply\n", "models/obj_000002.ply: mesh: with no PLY"),
    "model in m": (
        "models/obj_000001.ply", trimesh.creation.box(SIDES / 1000).export(file_type="ply"),
        "models/obj_000001.ply: mesh: part 'obj_000001' with a diameter of 7.6e-05",
    ),
    "picture of 16 bits": ("rgb/000001.png", depth(), "000001.png: image: pixels of type I;16"),
    "image without records": ("rgb/000009.png", picture(9), "scene_camera.json: 9: missing"),
}  # fmt: skip

REFUSED = {
    "rgb cut", "depth cut", "depth missing", "depth size", "depth colour",
    "mask size", "camera missing", "gt cut", "gt NaN", "gt deep", "gt list",
    "one info less", "duplicate key", "no image's number", "rotation scaled",
    "rotation mirrored", "rotation short", "rotation gone", "rotation of words",
    "object of words", "huge number", "object no record", "no pinhole",
    "K short", "depth scale", "fraction", "symmetry", "axis",
}  # fmt: skip
"""What the source cannot read: it raises what the check collects, by the same parser."""


@pytest.mark.parametrize("name", DAMAGES)
def test_every_damage_is_found_with_file_and_field(bop, name, spoilt, assert_found, assert_refused):
    *damage, expected = DAMAGES[name]
    spoil(bop, spoilt, *damage)
    assert_found(bop, expected)
    if name not in REFUSED:
        return
    cube = cuboid_keypoints(-SIDES / 2000, SIDES / 2000)
    parts = [Part(f"obj_{n:06d}", cube, 0.08, cube[:8]) for n in (1, 2)]
    expected = expected.replace("0.cam_K: K", "scene_camera.json: K ")
    assert_refused(lambda: BopReader(bop, parts, "train_pbr"), f"{expected}: ")


INDEPENDENT = [
    "rgb cut", "depth missing", "mask cut", "rotation scaled", "behind", "metres", "no camera",
    "diameter and box", "model cut", "K short", "fraction",
]  # fmt: skip


# A number that is not finite makes the file no JSON, and its other records are checked still.
@pytest.mark.parametrize("names", [INDEPENDENT, ["behind", "gt NaN"]])
def test_one_defect_hides_no_other(bop, names, spoilt, assert_found):
    for name in names:
        *damage, _ = DAMAGES[name]
        spoil(bop, spoilt, *damage)
    assert_found(bop, *(DAMAGES[name][2] for name in names))


def test_private_ground_truth_and_missing_models_are_notes(bop):
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


def first_null(infos: list[Any]) -> list[Any]:
    return [None, *infos[1:]]


NOTED = {
    "a rotation to a hundredth": ("gt:0.0.cam_R_m2c", times(1.004), "1 rotations are orthogonal"),
    "an image without info": ("gt_info:1", None, "2 objects without visib_fract"),
    "no info at all": ("gt_info", None, "6 objects without visib_fract"),
    "an image of empty info": ("gt_info:1", [], "2 objects without visib_fract"),
    "an object of null info": ("gt_info:1", first_null, "1 objects without visib_fract"),
    "an object of a box only": ("gt_info:0.0.visib_fract", None, "1 objects without visib_fract"),
    "a model missing": ("models/obj_000002.ply", None, "no file of object 2, left out"),
    "an object without a model": ("gt:0.0.obj_id", 9, "object 9 is annotated 1 times and has no"),
}


@pytest.mark.parametrize("name", NOTED)
def test_what_every_reader_copes_with_is_a_note(bop, name, spoilt):
    *damage, expected = NOTED[name]
    spoil(bop, spoilt, *damage)
    report = check_dataset(bop)
    assert report.ok, report.lines()
    assert any(expected in note for note in report.notes), report.notes


@pytest.mark.parametrize(
    "damage",
    [
        ("gt_info:0.1.visib_fract", 1.0000001),
        ("models:1.symmetries_discrete.0.0", times(1.004)),
    ],
)
def test_what_is_rounded_is_taken_by_check_and_reader(bop, damage, spoilt):
    spoil(bop, spoilt, *damage)
    assert check_dataset(bop).lines()[:-1] == []
    parts = bop_parts(bop)
    source = BopReader(bop, parts, "train_pbr")
    fractions = [one.visible_fraction for one in source.sample(0).instances]
    assert all(0 < fraction <= 1 for fraction in fractions)
    turn = parts[0].symmetries_discrete[0, :3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)


def test_pictures_and_depth_are_one_image_by_their_number(bop):
    (bop / SCENE / "rgb" / "000001.png").rename(bop / SCENE / "rgb" / "1.png")
    assert check_dataset(bop).ok
    np.testing.assert_allclose(BopReader(bop, bop_parts(bop), "train_pbr").sample(1).depth, 0.4)


def test_an_empty_folder_of_depth_is_none(bop):
    for path in (bop / SCENE / "depth").iterdir():
        path.unlink()
    assert check_dataset(bop).ok
    assert BopReader(bop, bop_parts(bop), "train_pbr").sample(0).depth is None


def test_a_scene_that_no_reader_finds_is_a_defect(bop, assert_found):
    (bop / SCENE).rename(bop / "train_pbr" / "kitchen")
    assert_found(bop, "train_pbr/kitchen: name: no scene's number")


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


@pytest.fixture
def shards(tmp_path, write_shard):
    root = tmp_path / "wds"
    write_models(root)
    (root / "train_pbr").mkdir()
    keys = {f"000000_{image:06d}": 0 for image in range(NUM_IMAGES)}
    (root / "train_pbr" / "key_to_shard.json").write_text(json.dumps(keys))
    write_shard(root / SHARD, good_members().items())
    return root


def good_members() -> dict[str, bytes]:
    return {k: v for image in range(NUM_IMAGES) for k, v in shard_members(image).items()}


SHARD = "train_pbr/shard-000000.tar"
FIRST = "000000_000000"
SHARD_DAMAGES = {
    "image cut": ("rgb.png", half, f"shard-000000.tar/{FIRST}.rgb.png: image: unreadable"),
    "no image": ("rgb.png", None, f"{FIRST}.rgb.png: member: missing"),
    "no camera": ("camera.json", None, f"{FIRST}.camera.json: member: missing"),
    "depth size": ("depth.png", SMALL, f"{FIRST}.depth.png: size"),
    "rotation": ("gt.json:0.cam_R_m2c", times(1.1), "gt.json: [0].cam_R_m2c: no rotation"),
    "behind": ("gt.json:0.cam_t_m2c", [0, 0, -1], f"{FIRST}.gt.json: [0].cam_t_m2c.z: behind"),
    "K": ("camera.json:cam_K", intrinsics(150, 640), f"{FIRST}.camera.json: cam_K:"),
    "runs": ("mask_visib.json:0.counts", [5], f"{FIRST}.mask_visib.json: 0: counts"),
    "mask gone": ("mask_visib.json:1", None, f"{FIRST}.mask_visib.json: 1: missing"),
    "json cut": ("gt.json", half, f"{FIRST}.gt.json: JSON: "),
    "moved": ("gt.json:1.cam_t_m2c", [90.0, 0.0, 340.0], "[1].box: "),
}

LISTS = {
    "archive: member '../evil.rgb.png'": lambda m: [("../evil.rgb.png", b"x"), *m],
    f"{FIRST}.gt.json' twice": lambda m: [*m, (f"{FIRST}.gt.json", b"[]")],
    f"{FIRST}: key: its members are not together": lambda m: [*m[1:], m[0]],
    "key_to_shard.json: 9_9: missing": lambda m: [
        *m, *((name.replace(FIRST, "9_9"), data) for name, data in shard_members(0).items())
    ],
}  # fmt: skip


@pytest.mark.parametrize("stated", [[], [None, None]])
def test_shards_may_state_no_visible_fraction(shards, stated, spoilt, write_shard):
    write_shard(
        shards / SHARD, in_first(spoilt, "gt_info.json", json.dumps(stated).encode()).items()
    )
    report = check_dataset(shards)
    assert report.ok, report.lines()
    assert any("2 objects without visib_fract" in note for note in report.notes)
    source = WebdatasetReader(shards, bop_parts(shards), "train_pbr")
    assert all(0 < one.visible_fraction <= 1 for one in source.sample(0).instances)


def test_good_shards_are_clean(shards):
    for root in (shards, shards / "train_pbr"):
        report = check_dataset(root)
        assert (report.layout, report.num_images) == ("BOP-WebDataset", NUM_IMAGES)
        assert report.defects == []


def in_first(spoilt: Any, place: str, value: Any) -> dict[str, bytes]:
    """The members of a good shard, of which one of the first image is spoilt."""
    name, _, keys = f"{FIRST}.{place}".partition(":")
    members = good_members()
    changed = spoilt(members.pop(name), keys, value)
    # In the first one's place: the members of an image lie together.
    return ({} if changed is None else {name: changed}) | members


@pytest.mark.parametrize("name", SHARD_DAMAGES)
def test_every_damage_in_a_shard_is_found(shards, name, spoilt, assert_found, write_shard):
    *damage, expected = SHARD_DAMAGES[name]
    write_shard(shards / SHARD, in_first(spoilt, *damage).items())
    assert_found(shards, expected)


@pytest.mark.parametrize("expected", LISTS)
def test_members_out_of_order_are_found(shards, expected, assert_found, write_shard):
    write_shard(shards / SHARD, LISTS[expected](list(good_members().items())))
    assert_found(shards, expected)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.97])
def test_shard_cut_short(shards, share, assert_found):
    content = (shards / SHARD).read_bytes()
    (shards / SHARD).write_bytes(content[: int(len(content) * share)])
    assert_found(shards, "shard-000000.tar: archive: ")


def test_a_bad_archive_does_not_hide_what_it_holds(shards, spoilt, assert_found, write_shard):
    *damage, _ = SHARD_DAMAGES["behind"]
    listed = list(in_first(spoilt, *damage).items())
    listed[2:2] = [("../evil.txt", b"x"), listed[0]]
    write_shard(shards / SHARD, listed)
    assert_found(shards, "archive", "behind the camera", "twice")


def test_shard_that_is_no_archive(shards, assert_found):
    (shards / "train_pbr" / "shard-000001.tar").write_bytes(b"\x1f\x8b" + bytes(600))
    assert_found(shards, "shard-000001.tar: archive")
    assert check_dataset(shards).num_images == NUM_IMAGES
