import json
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import trimesh

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_models import (
    bop_parts,
    model_numbers,
    parts_by_id,
    read_models,
    write_models,
)
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.mesh.decimate import decimate
from dopepp.parts.mesh.read import read_mesh, ycb_part
from dopepp.parts.part import make_part
from tests.data.makers import edit_json, pose_at
from tests.parts.makers import mesh_of

INFO, PLY = "models/models_info.json", "models/obj_000001.ply"


def test_written_parts_are_read_with_symmetries_in_metres(tmp_path):
    flip = pose_at(0.001, -0.002, 0.003) @ np.diag([1.0, -1, -1, 1])
    axis = ((0.0, 0.0, 1.0), (0.01, 0.0, -0.02))
    roll = mesh_of(trimesh.creation.cylinder(0.02, 0.05, sections=24))
    symmetries = {"symmetries_discrete": flip[None], "symmetries_continuous": (axis,)}
    symmetric = make_part("Rolle Ø4", roll, **symmetries)
    write_models(tmp_path, [symmetric, servoholder()])
    record = json.loads((tmp_path / INFO).read_text("utf-8"))["1"]
    assert record["name"] == "Rolle Ø4"
    assert record["symmetries_discrete"][0][3::4] == pytest.approx([1, -2, 3, 1])
    (entry,) = record["symmetries_continuous"]
    assert (entry["axis"], entry["offset"]) == ([0, 0, 1], pytest.approx([10, 0, -20]))
    assert record["diameter"] == pytest.approx(1000 * np.hypot(0.04, 0.05))
    assert [record[f"min_{a}"] for a in "xyz"] == pytest.approx([-20, -20, -25])
    assert [record[f"size_{a}"] for a in "xyz"] == pytest.approx([40, 40, 50])
    read, plain = bop_parts(tmp_path)
    np.testing.assert_allclose(read.symmetries_discrete, flip[None], atol=1e-12)
    np.testing.assert_allclose(read.symmetries_continuous, [axis], atol=1e-12)
    assert (plain.symmetries_discrete, plain.symmetries_continuous) == (None, ())
    np.testing.assert_allclose(read.cuboid, symmetric.cuboid, atol=1e-8)
    assert len(read.points) == 2000
    assert [part.name for part in bop_parts(tmp_path, ["servoholder"])] == ["servoholder"]


def test_a_part_may_be_named_after_its_model_file(tmp_path):
    write_models(tmp_path, [pivconnector(), servoholder()])
    (part,) = bop_parts(tmp_path, ["obj_000002"])
    (named,) = bop_parts(tmp_path, ["servoholder"])
    assert (part.name, part.mesh_hash) == ("obj_000002", named.mesh_hash)
    assert parts_by_id(tmp_path, [part]) == {2: part}
    assert parts_by_id(tmp_path, [named]) == {2: named}


def test_ply_is_read_by_trimesh_in_millimetres(tmp_path):
    path, mesh = tmp_path / PLY, pivconnector().mesh
    write_models(tmp_path, [pivconnector()])
    loaded = trimesh.load(path, process=False)
    np.testing.assert_allclose(loaded.vertices, 1000 * mesh.vertices, atol=1e-4)
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
    assert b"property float nx" in path.read_bytes()[:400]
    np.testing.assert_allclose(read_mesh(path, unit="mm").vertices, mesh.vertices, atol=1e-7)


def test_vertex_normals_are_weighted_by_angle(tmp_path):
    box = trimesh.creation.box((0.02, 0.02, 0.02))
    write_models(tmp_path, [make_part("box", mesh_of(box))])
    content = (tmp_path / PLY).read_bytes().partition(b"end_header\n")[2]
    columns = np.frombuffer(content, "<f4", 6 * 8).reshape(8, 6)
    # A corner has one or two triangles of each face; weights by angle make the three axes equal.
    np.testing.assert_allclose(columns[:, 3:], box.vertices / (0.01 * np.sqrt(3)), atol=1e-6)


def test_texture_round_trip(ycb_root, tmp_path):
    part = ycb_part(ycb_root, "009_gelatin_box")
    write_models(tmp_path, [part])
    (read,) = bop_parts(tmp_path)
    np.testing.assert_array_equal(read.mesh.texture, part.mesh.texture)
    np.testing.assert_allclose(read.mesh.uv, part.mesh.uv, atol=1e-6)
    np.testing.assert_allclose(read.mesh.vertices, part.mesh.vertices, atol=1e-7)


def test_parts_named_like_bops_files_keep_their_numbers(tmp_path):
    parts = [replace(servoholder(), name="obj_000012"), replace(pivconnector(), name="obj_000005")]
    write_models(tmp_path, parts)
    result = parts_by_id(tmp_path, bop_parts(tmp_path))
    assert [(number, result[number].name) for number in sorted(result)] == [
        (5, "obj_000005"), (12, "obj_000012"),
    ]  # fmt: skip
    np.testing.assert_allclose(result[5].diameter, parts[1].diameter, rtol=1e-6)
    assert result[5].diameter != pytest.approx(result[12].diameter, rel=1e-3)


@pytest.mark.parametrize("names", [("obj_5", "part"), ("obj_5", "obj_05"), ("obj_0", "obj_1")])
def test_other_parts_are_numbered_in_their_order(names):
    assert model_numbers(names) == dict(zip(names, (1, 2), strict=True))


def test_objects_without_a_name_are_named_after_their_file(tmp_path):
    def renumber(records):
        for record in records.values():
            del record["name"]
        return {"1": records["1"], "12": records["2"]}

    folder = tmp_path / "models"
    write_models(tmp_path, [servoholder(), pivconnector()])
    edit_json(tmp_path / INFO, renumber)
    (folder / "obj_000002.ply").rename(folder / "obj_000012.ply")
    folder.rename(tmp_path / "models_eval")
    parts = bop_parts(tmp_path)
    assert [part.name for part in parts] == ["obj_000001", "obj_000012"]
    assert parts_by_id(tmp_path, parts) == {1: parts[0], 12: parts[1]}
    assert list(parts_by_id(tmp_path / "none", parts[1:])) == [12]
    with pytest.raises(UserError, match=r"part 'servoholder'.*obj_000001, obj_000012"):
        parts_by_id(tmp_path, [servoholder()])
    with pytest.raises(UserError, match=r"part 'servoholder'.*obj_NNNNNN"):
        parts_by_id(tmp_path / "none", [servoholder()])
    with pytest.raises(UserError, match=r"data\.objects with 'x'.*obj_000001"):
        bop_parts(tmp_path, ["x"])
    with pytest.raises(UserError, match=r"no models_info\.json in models, models_cad"):
        bop_parts(tmp_path / "none")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        *(
            ({"1": record}, message)
            for record, message in [
                ({"diameter": -1}, r"1\.diameter: -1"),
                ({"diameter": "3"}, r"1\.diameter: '3'.*1 finite number"),
                ({"name": ""}, "printable characters"),
                ({"name": ["a"]}, "part name"),
                ({"symmetries_discrete": [[1] * 15]}, r"symmetries_discrete\[0\]: .*4×4 finite"),
                ({"symmetries_discrete": [[2.0] * 16]}, r"symmetries_discrete\[0\]: .*rigid"),
                ({"symmetries_discrete": 3}, "symmetries_discrete: 3; .*a list of at most"),
                ({"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0] * 3}]}, "axis other"),
                ({"symmetries_continuous": [{"axis": [0, 0, 1]}]}, "3 finite numbers"),
                ([], r"1: \[\]; .*diameter and symmetries"),
            ]
        ),
        ({"1": {}, "01": {}}, "'01': not an object number, or a repeated number"),
        ({"1": {"name": "a"}, "2": {"name": "a"}}, r"2\.name: 'a' twice"),
        ({"a": {}}, "objects by number"),
        ([], "objects by number"),
    ],
)
def test_damaged_models_info(content, message, tmp_path):
    (tmp_path / "models").mkdir()
    (tmp_path / INFO).write_text(json.dumps(content))
    with pytest.raises(UserError, match=message):
        read_models(tmp_path)


def test_the_identity_is_dropped_and_a_wrong_diameter_logged(tmp_path, caplog):
    write_models(tmp_path, [servoholder()])
    changes = {"symmetries_discrete": [np.eye(4).ravel().tolist()], "diameter": 90}
    edit_json(tmp_path / INFO, lambda records: records["1"].update(changes))
    (part,) = bop_parts(tmp_path)
    assert part.symmetries_discrete is None
    assert part.diameter == pytest.approx(servoholder().diameter, rel=1e-6)
    assert "states a diameter of 0.09 m" in caplog.text


def test_vertex_colours_round_trip_and_survive_decimation(tmp_path, monkeypatch):
    ball = trimesh.creation.icosphere(4, 0.03)
    shades = np.clip(128 + 4000 * ball.vertices, 0, 255).astype(np.uint8)
    mesh = replace(mesh_of(ball), colours=shades)
    write_models(tmp_path, [make_part("ball", mesh)])
    (read,) = bop_parts(tmp_path)
    np.testing.assert_array_equal(read.mesh.colours, shades)
    by_trimesh = trimesh.load(tmp_path / PLY, process=False)
    np.testing.assert_array_equal(by_trimesh.visual.vertex_colors[:, :3], shades)
    monkeypatch.setattr("dopepp.parts.part.MAX_FACES", 1000)
    monkeypatch.setattr("dopepp.parts.part.decimate", partial(decimate, max_faces=1000))
    light = make_part("ball", mesh).mesh
    assert len(light.faces) <= 1000
    expected = np.clip(128 + 4000 * light.vertices, 0, 255)
    np.testing.assert_allclose(light.colours, expected, atol=8)


def test_models_without_a_file_are_ignored_unless_requested(tmp_path, caplog):
    write_models(tmp_path, [servoholder(), pivconnector()])
    (tmp_path / PLY).unlink()
    assert [part.name for part in bop_parts(tmp_path)] == ["pivconnector"]
    assert "ignoring models without a file: servoholder" in caplog.text
    for requested in (["servoholder"], None):
        with pytest.raises(UserError, match=r"obj_000001.ply, no such file"):
            bop_parts(tmp_path, requested)
        (tmp_path / "models" / "obj_000002.ply").unlink(missing_ok=True)


def test_models_in_another_unit_or_with_too_many_triangles_are_rejected(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise ValueError("no larger triangles")

    write_models(tmp_path, [servoholder()])
    solid: Any = trimesh.creation.box((0.06, 0.04, 0.024))
    solid.export(tmp_path / PLY)
    with pytest.raises(UserError, match=r"5 mm – 5 m, from a file in millimetres") as error:
        bop_parts(tmp_path)
    assert "unit=" not in error.value.fix
    solid.apply_scale(1000).export(tmp_path / PLY)
    monkeypatch.setattr("dopepp.parts.part.MAX_FACES", 5)
    monkeypatch.setattr("dopepp.parts.part.decimate", refuse)
    with pytest.raises(UserError, match="allowed: up to 5 triangles"):
        bop_parts(tmp_path)
