import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from dopepp.cli import app
from dopepp.core.errors import UserError
from dopepp.data.part_symmetries import choose_symmetries
from dopepp.parts.catalogue import load_part


@pytest.fixture
def block(tmp_path):
    path = tmp_path / "block.stl"
    trimesh.creation.box((30, 20, 10)).apply_translation((5, 0, 0)).export(path)
    return load_part(path, "mm")


def test_auto_ignores_differences_that_a_camera_does_not_show(tmp_path):
    path = tmp_path / "prism.stl"
    trimesh.creation.box((30.0, 10.0, 10.8)).export(path)  # square but for 0.4 mm on each side
    part = load_part(path, "mm")
    for resolution, expected in ((0.0003, 3), (0.0006, 7)):
        (result,) = choose_symmetries([part], "auto", resolution)
        assert len(result.symmetries_discrete) == expected


def test_the_command_prints_an_entry_that_training_reads(block, tmp_path):
    result = CliRunner().invoke(app, ["symmetries", str(tmp_path / "block.stl"), "--unit", "mm"])
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
    (actual,), path = choose_symmetries([block], "auto"), tmp_path / "models_info.json"
    for content in (entry, {"4": entry}):
        path.write_text(json.dumps(content))
        (read,) = choose_symmetries([block], str(path))
        assert np.allclose(read.symmetries_discrete, actual.symmetries_discrete, atol=1e-12)


def test_symmetries_change_only_on_request(block):
    assert choose_symmetries([block], None) == [block]
    assert block.symmetries_discrete is None
    (result,) = choose_symmetries([block], "auto")
    assert choose_symmetries([result], None) == [result]
    (bare,) = choose_symmetries([result], "none")
    assert (bare.symmetries_discrete, bare.symmetries_continuous) == (None, ())


HALF_TURN = [-1, 0, 0, 10, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def test_entries_by_name_apply_to_the_named_parts(block, caplog):
    entry = {"symmetries_discrete": [HALF_TURN]}
    (given,) = choose_symmetries([block], {"block": entry, "absent": entry})
    np.testing.assert_allclose(given.symmetries_discrete[0, :3, 3], [0.01, 0, 0])
    assert caplog.messages == ["data.symmetries of absent: no part has this name"]
    assert choose_symmetries([given], {"other": entry}) == [given]
    axis = {"axis": [0, 0, 1], "offset": [0, 0, 0]}
    (round_part,) = choose_symmetries([given], {"block": {"symmetries_continuous": [axis]}})
    assert round_part.symmetries_discrete is None
    assert round_part.symmetries_continuous == (((0, 0, 1), (0, 0, 0)),)


@pytest.mark.parametrize(("choice", "message"), [
    ("gone.json", r"data.symmetries=gone.json, no such file.*none, auto"),
    ("other.json", r"other.json, which has no entry for block.*other"),
    ({"block": [HALF_TURN]},
     r"data.symmetries.block: .*symmetries_discrete and symmetries_continuous"),
    ({"block": {"half_turns": 1}}, r"data.symmetries.block: .*symmetries_discrete and"),
    ({"block": {"symmetries_discrete": [[1] * 16]}},
     r"block: symmetries_discrete\[0\]: not a rotation"),
], ids=str)  # fmt: skip
def test_invalid_choices_are_rejected(block, choice, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("other.json").write_text('{"1": {"name": "other", "diameter": 10}}')
    with pytest.raises(UserError, match=message):
        choose_symmetries([block], choice)


def test_parts_without_a_mesh_and_wrong_options_are_rejected(block, tmp_path):
    bare = replace(block, mesh=None)
    with pytest.raises(UserError, match="part block without a mesh"):
        choose_symmetries([bare], "auto")
    stl, gone = str(tmp_path / "block.stl"), str(tmp_path / "gone.stl")
    for arguments in ([stl, "--unit", "mm", "--tolerance", "2"], [gone]):
        assert CliRunner().invoke(app, ["symmetries", *arguments]).exit_code == 2
