"""BOP challenge CSVs: files of the BOP toolkit, round trips, and wrong files."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.data.formats.bop import bop_results
from dopepp.data.formats.bop.bop_results import BopResult, read_results, results_name, write_results
from dopepp.geometry.camera import make_transform

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
R, T = "1 0 0 0 0 -1 0 1 0", "-10.5 20 812.25"
GOOD = f"1,4,2,0.75,{R},{T},0.5"

BY_HAND = f"""{HEADER}
{GOOD}
1,4,2,0.25,1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0,1e2 -2.5E+1 +900.,0.5
48,1000,21,-3,  0 -1 0  1 0 0  0 0 1 , 0 0 1500,-1
"""


def write(folder: Path, content: str | bytes) -> Path:
    path = folder / "method_set-test.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_a_file_in_the_toolkits_format(tmp_path):
    results = read_results(write(tmp_path, BY_HAND), {2, 21})
    assert [(r.scene_id, r.im_id, r.obj_id, r.score, r.seconds) for r in results] == [
        (1, 4, 2, 0.75, 0.5), (1, 4, 2, 0.25, 0.5), (48, 1000, 21, -3, -1),
    ]  # fmt: skip
    expected = np.array([[1, 0, 0, -0.0105], [0, 0, -1, 0.02], [0, 1, 0, 0.81225], [0, 0, 0, 1]])
    np.testing.assert_allclose(results[0].T_cam_obj, expected, atol=1e-15)
    np.testing.assert_allclose(results[1].T_cam_obj[:3, 3], [0.1, -0.025, 0.9], atol=1e-15)


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        f"{HEADER}\r\n{GOOD}\r\n",
        f"\ufeff{HEADER}\n\n{GOOD}\n\n",
        f"scene_id, im_id, obj_id, score, R, t, time\n{GOOD.replace(',', ' , ')}",
    ],
)
def test_header_blanks_and_line_ends_may_vary(content, tmp_path):
    (result,) = read_results(write(tmp_path, content), {2})
    assert (result.im_id, result.score, result.seconds) == (4, 0.75, 0.5)


@given(seed=st.integers(0, 10_000), count=st.integers(0, 12))
def test_what_is_written_is_read_back(seed, count, tmp_path_factory):
    rng = np.random.default_rng(seed)
    results = []
    for number in range(count):
        T = make_transform(Rotation.random(rng=rng).as_matrix(), rng.normal([0, 0, 1], 0.2))
        results.append(BopResult(number // 5, number % 5, 1 + number % 3, rng.normal(), T, 0.1))
    path = tmp_path_factory.mktemp("results") / "out.csv"
    write_results(path, results)
    assert path.read_text().splitlines()[0] == HEADER
    for detection, back in zip(results, read_results(path, {1, 2, 3}), strict=True):
        np.testing.assert_allclose(back.T_cam_obj, detection.T_cam_obj, rtol=0, atol=1e-12)
        assert vars(back) | {"T_cam_obj": 0} == vars(detection) | {"T_cam_obj": 0}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1,4,2,0.75", r"line 2 with 4 fields; allowed: 7: scene_id,im_id"),
        (GOOD + ",", r"line 2 with 8 fields"),
        (GOOD.replace("1,4", "x,4", 1), r"line 2: scene_id 'x'; allowed: a whole number"),
        (GOOD.replace("1,4", "-1,4", 1), r"line 2: scene_id '-1'"),
        (GOOD.replace("1,4", "1,4.5", 1), r"line 2: im_id '4\.5'"),
        (GOOD.replace("1,4", "1,99999999999", 1), r"line 2: im_id"),
        (GOOD.replace(",2,", ",7,", 1), r"line 2: obj_id 7; allowed: the data set's objects: 2, 3"),
        (GOOD.replace("0.75", "nan"), r"line 2: score: 'nan'; allowed: finite numbers"),
        (GOOD.replace("0.75", "1e999"), r"line 2: score: '1e999'"),
        (GOOD.replace("0.75", "1_0"), r"line 2: score: '1_0'"),
        (GOOD.replace("0.75", ""), r"line 2: score with 0: ''; allowed: 1 number"),
        (GOOD.replace(R, "1 0 0 0 1 0 0 0"), r"line 2: R with 8: .*; allowed: 9 numbers"),
        (GOOD.replace(R, "[1 0 0 0 1 0 0 0 1]"), r"line 2: R: '\[1'"),
        (GOOD.replace(R, "1 0 0 0 1 0 0 0 -1"), r"line 2: R .*; allowed: a rotation matrix"),
        (GOOD.replace(R, "1.002 0 0 0 1 0 0 0 1"), r"line 2: R .*within 1e-3"),
        (GOOD.replace(R, "1e200 0 0 0 1 0 0 0 1"), r"line 2: R .*a rotation matrix"),
        (GOOD.replace("-10.5 20", "20"), r"line 2: t with 2: '20 812\.25'; allowed: 3 numbers"),
        (GOOD.replace("-10.5", "NaN"), r"line 2: t: 'NaN'"),
        (GOOD.replace("-10.5", "1e12"), r"line 2: t .*; allowed: millimetres"),
        (GOOD.replace("812.25,0.5", "812.25,-2"), r"line 2: time '-2'; allowed: seconds, or -1"),
        (GOOD.replace("812.25,0.5", "812.25,inf"), r"line 2: time: 'inf'"),
        (GOOD.replace(T, "-0.01 0.02 0.81"), r"median length of 0\.8103, e\.g\. in line 2.*metres"),
        (GOOD.replace(T, "0 0 812250"), r"median length of 8\.\d+e\+05, e\.g\. in line 2"),
        (f"{GOOD}\n1,5,2,0.75,{R},0 0 700,1\n{GOOD}", r"line 4, which repeats line 2;.*once"),
        (GOOD + "é", r"line 2, which is not ASCII text"),
        (GOOD.replace("0.75", "0" * 5000), r"line 2 of more than 4096 bytes"),
        (HEADER, r"line 2: scene_id 'scene_id'"),
    ],
)
def test_a_wrong_line_is_rejected_with_its_number(line, message, tmp_path):
    path = write(tmp_path, f"{HEADER}\n{line}\n")
    with pytest.raises(UserError, match=message) as error:
        read_results(path, {2, 3})
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600 + len(str(path))


def test_a_pose_may_be_repeated_with_another_score(tmp_path):
    again = GOOD.replace("0.75", "0.7")
    assert len(read_results(write(tmp_path, f"{GOOD}\n{again}"), {2})) == 2


@pytest.mark.parametrize(("content", "message"), [
    ("", "which is empty"),
    (b"\x89PNG\r\n\x1a\n" + bytes(10_000), "line 1"),
    ("\n".join(GOOD.replace("0.75", f"0.{n}") for n in (1, 2, 3)),
     "line 3; allowed: at most 2 poses"),
    (None, "no such file"),
], ids=["empty", "binary", "too many", "missing"])  # fmt: skip
def test_other_files_are_rejected(content, message, tmp_path, monkeypatch):
    monkeypatch.setattr(bop_results, "MAX_ROWS", 2)
    paths = [tmp_path, tmp_path / "none.csv"] if content is None else [write(tmp_path, content)]
    for path in paths:
        with pytest.raises(UserError, match=message):
            read_results(path, {2})


@pytest.mark.parametrize(
    ("method", "dataset", "split", "name"),
    [
        ("dopepp", "lmo", "test", "dopepp_lmo-test.csv"),
        ("a (baseline)", "ycb_video", "train_pbr", "a-baseline_ycbvideo-train-pbr.csv"),
        ("a/../b_c", "../..", "", "a-..-b-c_data-test.csv"),
        ("_", "-", "/", "method_data-test.csv"),
    ],
)
def test_file_names_have_bops_three_parts(method, dataset, split, name):
    assert results_name(method, dataset, split) == name
    assert name.count("_") == 1
