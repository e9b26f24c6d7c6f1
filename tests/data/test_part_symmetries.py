import json

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from dopepp.cli import app
from dopepp.core.errors import UserError
from dopepp.data.part_symmetries import choose_symmetries
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Part


@pytest.fixture
def stl(tmp_path):
    path = tmp_path / "block.stl"
    trimesh.creation.box((30, 20, 10)).apply_translation((5, 0, 0)).export(path)
    return path


def test_auto_ignores_differences_that_a_camera_does_not_show(tmp_path):
    path = tmp_path / "prism.stl"
    trimesh.creation.box((30.0, 10.0, 10.8)).export(path)  # square but for 0.4 mm on each side
    part = load_part(path, "mm")
    for resolution, expected in ((0.0003, 3), (0.0006, 7)):
        (result,) = choose_symmetries([part], "auto", resolution)
        assert len(result.symmetries_discrete) == expected


def test_the_command_prints_an_entry_that_training_reads(stl, tmp_path):
    result = CliRunner().invoke(app, ["symmetries", str(stl), "--unit", "mm"])
    assert result.exit_code == 0
    entry = json.loads(result.stdout)
    assert entry["diameter"] == pytest.approx(np.sqrt(1400))
    assert [entry[f"min_{axis}"] for axis in "xyz"] == pytest.approx([-10, -10, -5])
    assert [entry[f"size_{axis}"] for axis in "xyz"] == pytest.approx([30, 20, 10])
    assert entry["symmetries_continuous"] == []
    rows = np.array(entry["symmetries_discrete"])
    assert rows.shape == (3, 16)
    # Half a turn about y or z through x = 5 mm moves the origin by 10 mm.
    assert sorted(rows[:, 3].tolist()) == pytest.approx([0, 10, 10])
    for content in (entry, {"4": entry}):
        path = tmp_path / "models_info.json"
        path.write_text(json.dumps(content))
        (read,) = choose_symmetries([load_part(stl, "mm")], str(path))
        (actual,) = choose_symmetries([load_part(stl, "mm")], "auto")
        assert np.allclose(read.symmetries_discrete, actual.symmetries_discrete, atol=1e-12)


def test_symmetries_change_only_on_request(stl):
    part = load_part(stl, "mm")
    assert choose_symmetries([part], None) == [part]
    assert part.symmetries_discrete is None
    (result,) = choose_symmetries([part], "auto")
    assert choose_symmetries([result], None) == [result]
    (bare,) = choose_symmetries([result], "none")
    assert bare.symmetries_discrete is None
    assert bare.symmetries_continuous == ()


def test_wrong_files_and_parts_are_rejected(stl, tmp_path):
    part = load_part(stl, "mm")
    with pytest.raises(UserError, match=r"data.symmetries=gone.json, no such file.*none, auto"):
        choose_symmetries([part], "gone.json")
    path = tmp_path / "other.json"
    path.write_text('{"1": {"name": "other", "diameter": 10}}')
    with pytest.raises(UserError, match=r"other.json, which has no entry for block.*other"):
        choose_symmetries([part], str(path))
    bare = Part("bare", part.cuboid, part.diameter, part.points)
    with pytest.raises(UserError, match="part bare without a mesh"):
        choose_symmetries([bare], "auto")
    for arguments in ([str(stl), "--unit", "mm", "--tolerance", "2"], [str(tmp_path / "gone.stl")]):
        assert CliRunner().invoke(app, ["symmetries", *arguments]).exit_code == 2


def test_a_round_part_has_its_axis_in_millimetres(tmp_path):
    path = tmp_path / "can.stl"
    trimesh.creation.cylinder(33, 100, sections=48).apply_translation((0, 12, 0)).export(path)
    entry = json.loads(CliRunner().invoke(app, ["symmetries", str(path)]).stdout)
    (axis,) = entry["symmetries_continuous"]
    assert axis["axis"] == pytest.approx([0, 0, 1], abs=1e-6)
    assert axis["offset"] == pytest.approx([0, 12, 0], abs=1e-3)
    assert len(entry["symmetries_discrete"]) == 1


HALF_TURN = [-1, 0, 0, 10, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def test_entries_by_name_apply_to_the_named_parts(stl):
    part = load_part(stl, "mm")
    entry = {"symmetries_discrete": [HALF_TURN]}
    (given,) = choose_symmetries([part], {"block": entry, "absent": entry})
    np.testing.assert_allclose(given.symmetries_discrete[0, :3, 3], [0.01, 0, 0])
    assert choose_symmetries([given], {"other": entry}) == [given]
    (round_part,) = choose_symmetries(
        [given], {"block": {"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}}
    )
    assert round_part.symmetries_discrete is None
    assert round_part.symmetries_continuous == (((0, 0, 1), (0, 0, 0)),)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ([HALF_TURN], r"data.symmetries.block: .*symmetries_discrete and symmetries_continuous"),
        ({"half_turns": 1}, r"data.symmetries.block: .*symmetries_discrete and"),
        ({"symmetries_discrete": [[1] * 16]}, r"block: symmetries_discrete\[0\]: not a rotation"),
    ],
)
def test_invalid_entries_are_rejected(stl, entry, message):
    with pytest.raises(UserError, match=message):
        choose_symmetries([load_part(stl, "mm")], {"block": entry})
