"""Distinguish a data set from a folder of data sets."""

import pytest

from dopepp.core.errors import UserError
from dopepp.data.check import check_dataset
from dopepp.data.formats import RECORD_FILE


def make(root, *names):
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")


BOP = "train_pbr/000000/scene_gt.json"
NDDS = ("000000.json", "000000.png", "_object_settings.json")


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ([f"bracket/{BOP}", *(f"plate/{name}" for name in NDDS)],
         r"2 data sets: bracket \(BOP\), plate \(NDDS\)"),
        ([f"bracket/{BOP}"], r"1 data sets: bracket \(BOP\)"),
        ([f"{item}/{name}" for item in "ab" for name in (*NDDS, RECORD_FILE)],
         r"2 data sets: a \(NDDS\), b \(NDDS\)"),
        ([f"set{n}/{BOP}" for n in range(10)], r"10 data sets: set0 .*set7 \(BOP\) and 2 more"),
    ],
)  # fmt: skip
def test_a_folder_of_data_sets_is_rejected(names, found, tmp_path):
    make(tmp_path, *names)
    first = min(name.split("/")[0] for name in names)
    with pytest.raises(UserError, match=found) as error:
        check_dataset(tmp_path)
    assert error.value.fix.endswith(f"dopepp check {tmp_path / first}")


def test_folders_of_scenes_are_one_data_set(tmp_path):
    make(tmp_path, *(f"{scene}/{name}" for scene in ("kitchen_0", "forest_1") for name in NDDS))
    assert check_dataset(tmp_path).layout == "NDDS"


@pytest.mark.parametrize("names", [[], ["notes/readme.txt"]])
def test_a_folder_of_unknown_layout_is_rejected(names, tmp_path):
    make(tmp_path, *names)
    with pytest.raises(UserError, match="a folder with an unknown layout"):
        check_dataset(tmp_path)
