"""``dopepp check`` on YCB-Video, real and made up, and on folders of no or several layouts."""

import logging
import re
import shutil
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data.check import check_dataset
from dopepp.data.formats.problems import MAX_KEPT, CheckReport
from dopepp.data.formats.ycb_video.reader import YcbVideoReader
from dopepp.geometry.camera import camera_matrix

FRAME = "0000/000001"
HALF = np.array([0.04, 0.03, 0.02])


@pytest.fixture
def ycb(ycb_tree):
    rng = np.random.default_rng(0)
    for name in ("002_can", "003_box", "004_mug"):
        folder = ycb_tree.root / "models" / name
        folder.mkdir(parents=True)
        np.savetxt(folder / "points.xyz", rng.uniform(-1, 1, (500, 3)) * HALF)
    ycb_tree.write(FRAME)
    ycb_tree.write("0000/000002")
    ycb_tree.write("data_syn/000000", (1,))
    ycb_tree.path(FRAME, "box.txt").write_text("003_box 30 20 60 50\n")
    ycb_tree.write_list("train", [FRAME, "data_syn/000000"])
    return ycb_tree


def test_a_good_folder_is_clean(ycb):
    report = check_dataset(ycb.root)
    assert (report.layout, report.num_images, report.defects, report.notes) == (
        "YCB-Video", 3, [], [],
    )  # fmt: skip


def test_the_real_frames_are_clean(ycb_root):
    report = check_dataset(ycb_root)
    assert (report.layout, report.num_images, report.defects) == ("YCB-Video", 9, [])
    (note,) = report.notes
    assert note.startswith("keyframe.txt lists 2,948 frames")


def poses(**changes: Any) -> Callable[[Any], None]:
    """Write the frame again with a pose's elements changed: ``R00=2``, ``tz=-1``."""

    def damage(tree: Any) -> None:
        stack = tree.write(FRAME)
        for name, value in changes.items():
            place = (int(name[1]), int(name[2])) if name[0] == "R" else ("xyz".index(name[1]), 3)
            stack[(*place, 0)] = value
        tree.write(FRAME, poses=stack)

    return damage


def write(**fields: Any) -> Callable[[Any], Any]:
    return lambda tree: tree.write(FRAME, **fields)


def spoil(what: str, value: Any) -> Callable[[Any], Any]:
    """Cut a file of the frame short, or remove (None), overwrite or paint it."""

    def damage(tree: Any) -> None:
        path = tree.path(FRAME, what)
        if value is None:
            path.unlink()
        elif isinstance(value, np.ndarray):
            cv2.imwrite(str(path), value)
        else:
            path.write_bytes(path.read_bytes()[:value] if isinstance(value, int) else value)

    return damage


DAMAGES = {
    "colour cut": (spoil("color.png", -300), "color.png: image: of "),
    "colour missing": (spoil("color.png", None), "color.png: file: missing"),
    "depth missing": (spoil("depth.png", None), "depth.png: file: missing"),
    "label missing": (spoil("label.png", None), "label.png: file: missing"),
    "meta missing": (spoil("meta.mat", None), "meta.mat: file: No such file"),
    "meta cut": (spoil("meta.mat", -300), "meta.mat: file: "),
    "meta empty": (spoil("meta.mat", b""), "meta.mat: file: damaged"),
    "label size": (spoil("label.png", np.zeros((9, 9), np.uint8)), "label.png: size: 9×9"),
    "depth size": (spoil("depth.png", np.zeros((9, 9), np.uint16)), "depth.png: size: 9×9"),
    "label colour": (spoil("label.png", np.zeros((72, 96, 3), np.uint8)), "label.png: channels: "),
    "label of nobody": (
        spoil("label.png", np.full((72, 96), 3, np.uint8)),
        "label.png: values: classes [3] without a pose",
    ),
    "no rotation": (poses(R00=1.1), "meta.mat: poses[0].R: no rotation"),
    "mirrored": (poses(R22=-1), "determinant -1"),
    "NaN": (poses(R00=np.nan), "meta.mat: poses[0]: not finite"),
    "behind": (poses(tz=-0.3), "meta.mat: poses[0].z: behind the camera"),
    "millimetres": (poses(tz=300.0), "meta.mat: poses[0].unit: "),
    "moved": (poses(tx=0.1), "meta.mat: poses[0].box: seen at"),
    "unknown class": (write(cls_indexes=[[9]]), "cls_indexes[0]: unknown class 9"),
    "class twice": (
        write(classes=(2, 3), cls_indexes=[[2], [2]]), "cls_indexes[1]: class 2 twice"
    ),
    "poses and classes": (write(cls_indexes=[[2], [3]]), "poses: shape"),
    "no poses": (write(poses=None), "meta.mat: poses: missing"),
    "no factor": (write(factor_depth=None), "meta.mat: factor_depth: missing"),
    "factor": (write(factor_depth=-1), "meta.mat: factor_depth: -1"),
    "K": (
        write(intrinsic_matrix=camera_matrix(100.0, 100.0, 999.0, 35.0)),
        "meta.mat: intrinsic_matrix: K",
    ),
    "K NaN": (
        write(intrinsic_matrix=np.full((3, 3), np.nan)), "intrinsic_matrix: not finite"
    ),
    "box of words": (spoil("box.txt", b"003_box a b c d\n"), "box.txt: line 1: '003_box a"),
    "box of nobody": (spoil("box.txt", b"x 1 2 3 4\n"), "box.txt: line 1: unknown object 'x'"),
    "box turned": (spoil("box.txt", b"003_box 9 9 2 2\n"), "box.txt: line 1: '003_box 9"),
    "box outside": (spoil("box.txt", b"003_box 300 9 400 20\n"), "outside the 96×72 image"),
    "points": (
        lambda tree: (tree.root / "models/003_box/points.xyz").write_text("1 2\n"),
        "models/003_box/points.xyz: points: ",
    ),
    "list": (
        lambda tree: tree.write_list("train", ["0000/x"]), "image_sets/train.txt: line: line '0000"
    ),
    "class list": (
        lambda tree: tree.write_list("classes", ["003_box", "003_box"]), "classes.txt: names: "
    ),
}  # fmt: skip


REFUSED = {
    "colour cut", "depth missing", "label missing", "meta missing", "meta cut", "label size",
    "depth size", "label colour", "no rotation", "NaN", "behind", "class twice",
    "poses and classes", "no poses", "no factor", "factor", "K", "K NaN", "list",
}  # fmt: skip
"""What the source cannot read: it raises what the check collects, by the same parser."""


@pytest.mark.parametrize("name", DAMAGES)
def test_every_damage_is_found_with_file_and_field(ycb, box, name, assert_found, assert_refused):
    damage, expected = DAMAGES[name]
    damage(ycb)
    assert_found(ycb.root, expected)
    assert check_dataset(ycb.root).num_images == 3
    if name in REFUSED:
        expected = expected.replace("meta.mat: intrinsic_matrix: K", "meta.mat: K")
        assert_refused(lambda: YcbVideoReader(ycb.root, [box], "train"), expected)


def test_one_defect_hides_no_other(ycb, assert_found):
    poses(R00=1.1, tz=-0.3)(ycb)
    for name in ("colour cut", "depth size", "box of nobody"):
        DAMAGES[name][0](ycb)
    assert_found(
        ycb.root, "poses[0].R", "poses[0].z", "color.png: image", "depth.png: size", "line 1"
    )


def test_unlabelled_objects_and_absent_models_are_no_defects(ycb):
    ycb.write(FRAME, labelled=False)
    shutil.rmtree(ycb.root / "models" / "004_mug")
    ycb.write("0000/000003", (3,))
    ycb.write_list("val", ["0000/000009"])
    report = check_dataset(ycb.root)
    assert report.defects == []
    absent, missing = report.notes
    assert absent.startswith("val.txt lists 1 frames")
    assert missing.startswith("models/004_mug/points.xyz is missing")


def test_unknown_layouts(tmp_path):
    (tmp_path / "readme.txt").touch()
    (tmp_path / "notes.json").write_text("{}")
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(UserError, match="BOP-WebDataset shards"):
            check_dataset(folder)


def test_report_lines_are_capped_and_counted(tmp_path):
    report = CheckReport(tmp_path, "BOP")
    for number in range(MAX_KEPT + 5):
        report.report(tmp_path / "a" / f"{number}.json", "0.cam_K", "two\nlines")
    report.note("worth knowing")
    report.note("worth knowing")
    lines = report.lines(3)
    assert lines[0] == "note: worth knowing"
    assert lines[1] == "a/0.json: 0.cam_K: two lines"
    assert lines[4] == f"… and {MAX_KEPT + 2:,} more"
    assert re.search(r"BOP, 0 images, 10,005 defects \(cam_K 10,005\)$", lines[5])
    assert len(lines) == 6
    assert len(report.defects) == MAX_KEPT
    assert not report.ok


def test_progress_is_told(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        report = CheckReport(tmp_path, "NDDS")
        for _ in range(1000):
            report.count_image()
    assert "1000 images checked, 0 defects" in caplog.text
