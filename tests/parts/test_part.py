import copy
import json

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from dopepp.core.errors import UserError
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.parts import Mesh, Part, make_part, servoholder
from dopepp.parts.part import FIELDS, MAX_POINTS


def box(size: tuple[float, float, float]) -> Mesh:
    mesh = trimesh.creation.box(size)
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))


def test_measures_a_box():
    part = make_part("box", box((0.03, 0.04, 0.12)))
    assert part.name == "box"
    assert part.diameter == pytest.approx(0.13, rel=1e-15)
    half = np.array([0.015, 0.02, 0.06])
    np.testing.assert_allclose(part.cuboid, cuboid_keypoints(-half, half), atol=1e-18)
    assert part.points.shape == (2000, 3)
    assert part.symmetries_discrete is None
    assert part.symmetries_continuous == ()


def test_points_alone_make_a_part_without_mesh():
    points = np.array([[0, 0, 0], [0.03, 0, 0], [0.03, 0.04, 0], [0.0, 0.04, 0.1]])
    np.testing.assert_array_equal(make_part("box", box((0.1, 0.1, 0.1)), points).points, points)
    with pytest.raises(ValueError, match="a mesh or points"):
        make_part("nothing", None)
    part = make_part("cloud", None, points)
    assert part.mesh is None
    assert part.mesh_hash == ""
    assert part.diameter == pytest.approx(np.linalg.norm([0.03, 0.04, 0.1]))
    np.testing.assert_allclose(part.cuboid[8], [0.015, 0.02, 0.05])


def test_hash_tells_meshes_apart():
    mesh = box((0.1, 0.1, 0.1))
    moved = Mesh(np.nextafter(mesh.vertices, 1), mesh.faces)
    turned = Mesh(mesh.vertices, mesh.faces[:, [1, 2, 0]])
    hashes = {make_part("box", m).mesh_hash for m in (mesh, moved, turned)}
    assert len(hashes) == 3
    assert all(len(h) == 64 for h in hashes)
    assert make_part("other", box((0.1, 0.1, 0.1))).mesh_hash in hashes


@pytest.mark.parametrize(
    ("scale", "unit", "message"),
    [
        (1000, "m", r"'holder' with a diameter of 104\.8 m, .* unit=m; .*5 mm – 5 m; .*unit=mm"),
        (0.001, "mm", r"diameter of 0\.0001048 m, .* unit=mm; .* fix: .*unit=m$"),
        (0.01, "mm", r"diameter of 0\.001048 m, .* fix: .*unit=cm"),
        (0.0, "mm", r"diameter of 0 m, .* fix: check the file's size"),
    ],
)
def test_an_unlikely_size_names_the_unit_and_suggests_one(scale, unit, message):
    mesh = servoholder().mesh
    with pytest.raises(UserError, match=message):
        make_part("holder", Mesh(scale * mesh.vertices, mesh.faces), unit=unit)


@pytest.mark.parametrize("diameter", [0.005, 5.0])
def test_the_allowed_sizes_include_their_ends(diameter):
    points = np.array([[0.0, 0, 0], [diameter, 0, 0]])
    assert make_part("rod", None, points).diameter == diameter


@pytest.mark.parametrize("name", ["", "x" * 201, "two\nlines"])
def test_a_name_must_be_printable(name):
    with pytest.raises(UserError, match=r"part name .* printable characters"):
        make_part(name, box((0.1, 0.1, 0.1)))


def symmetric_part() -> Part:
    mesh = servoholder().mesh
    turn = np.eye(4)
    turn[:3, :3] = rotation_vector_to_matrix(np.array([0, 0, np.pi]))
    return make_part(
        "holder",
        mesh,
        symmetries_discrete=turn[None],
        symmetries_continuous=(((0.0, 0.0, 1.0), (0.01, 0.0, 0.0)),),
    )


RECORD = make_part("p", None, np.array([[0.0, 0, 0], [0.1, 0.2, 0.3]])).to_record()
BAD_CUBOIDS = {
    "8 rows": RECORD["cuboid"][:8],
    "reversed": RECORD["cuboid"][::-1],
    "two corners swapped": [RECORD["cuboid"][i] for i in (1, 0, 2, 3, 4, 5, 6, 7, 8)],
    "centre elsewhere": [*RECORD["cuboid"][:8], [0.0, 0.0, 0.0]],
    "4 columns": [[*row, 0.0] for row in RECORD["cuboid"]],
}
SCALED = np.eye(4) * 2


@pytest.mark.parametrize("part", [servoholder(), symmetric_part()], ids=lambda p: p.name)
def test_a_record_survives_json_without_loss(part):
    again = Part.from_record(json.loads(json.dumps(part.to_record())))
    assert again.mesh is None
    assert (again.name, again.diameter) == (part.name, part.diameter)
    assert again.mesh_hash == part.mesh_hash
    np.testing.assert_array_equal(again.cuboid, part.cuboid)
    np.testing.assert_array_equal(again.points, part.points)
    assert again.symmetries_continuous == part.symmetries_continuous
    if part.symmetries_discrete is None:
        assert again.symmetries_discrete is None
    else:
        np.testing.assert_array_equal(again.symmetries_discrete, part.symmetries_discrete)
    assert again.to_record() == part.to_record()


def test_no_symmetries_differ_from_unknown_ones():
    known = Part.from_record({**RECORD, "symmetries_discrete": []})
    assert known.symmetries_discrete.shape == (0, 4, 4)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("name", "", "part name ''"),
        ("name", "x" * 201, "1–200 printable"),
        ("name", "a\x1b[2Jb", "printable"),
        ("name", b"p", "a part name that is b'p'"),
        ("diameter", 0.0, "diameter 0.0; .*above 0"),
        ("diameter", -1.0, "diameter -1.0"),
        ("diameter", float("nan"), "diameter nan"),
        ("diameter", float("inf"), "diameter inf"),
        ("diameter", True, "diameter True"),
        ("diameter", "0.1", "diameter '0.1'"),
        ("diameter", 10**400, "diameter 1000"),
        ("points", [], "points of 0 rows; .* 1 – 100000 lists of 3"),
        ("points", None, "points of type NoneType"),
        ("points", "abc", "points of type str"),
        ("points", {"0": [0, 0, 0]}, "points of type dict"),
        ("points", [[0.0, 0.0]], "row of another length"),
        ("points", [[0.0, 0.0, 0.0], [0.0]], "row of another length"),
        ("points", [0.0, 0.0, 0.0], "row of another length"),
        ("points", ["abc"], "row of another length"),
        ("points", [[0.0, 0.0, "1"]], "no number of metres"),
        ("points", [[0.0, 0.0, float("nan")]], "no number of metres"),
        ("points", [[0.0, 0.0, -float("inf")]], "no number of metres"),
        ("points", [[0.0, 0.0, 1e300]], "no number of metres"),
        ("points", [[0.0, 0.0, 10**400]], "no number of metres"),
        ("points", [[0.0, 0.0, True]], "no number of metres"),
        ("points", [[0.0, 0.0, [0.0]]], "no number of metres"),
        ("points", [[0, 0, 0]] * (MAX_POINTS + 1), "points of 100001 rows"),
        ("mesh_hash", "abc", "mesh_hash 'abc'; .*64 hexadecimal"),
        ("mesh_hash", "g" * 64, "mesh_hash"),
        ("mesh_hash", None, "mesh_hash None"),
        ("symmetries_discrete", [[[1.0] * 4] * 4], "no rigid transform"),
        ("symmetries_discrete", [SCALED.tolist()], "no rigid transform"),
        ("symmetries_discrete", [np.diag([1, 1, -1, 1]).tolist()], "no rigid transform"),
        ("symmetries_discrete", [np.eye(3).tolist()], "symmetries_discrete of 3 rows"),
        ("symmetries_discrete", np.eye(4).tolist(), "symmetries_discrete of 4 rows|another length"),
        ("symmetries_discrete", 5, "symmetries_discrete of type int"),
        ("symmetries_discrete", [np.eye(4).tolist()] * 1001, "symmetries_discrete of 1001 rows"),
        ("symmetries_continuous", None, "symmetries_continuous of type NoneType"),
        ("symmetries_continuous", [[[0, 0, 0], [0, 0, 0]]], "axis of length 0"),
        ("symmetries_continuous", [[[0, 0, 1]]], "symmetries_continuous of 1 rows"),
        ("symmetries_continuous", [[[[0, 0, 1], [0, 0, 0]]] * 1001][0], "of 1001 rows"),
        *[("cuboid", rows, "cuboid") for rows in BAD_CUBOIDS.values()],
    ],
)
def test_a_bad_field_is_named(field, value, message):
    with pytest.raises(UserError, match=message) as caught:
        Part.from_record({**RECORD, field: value})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    "record",
    [
        *(None, [], "record", 1, {}, {1: 2}, {**RECORD, "mesh": None}, [*RECORD.items()]),
        *[{key: RECORD[key] for key in RECORD if key != field} for field in FIELDS],
    ],
)
def test_another_thing_is_no_record(record):
    with pytest.raises(UserError, match=r"part record: .* a mapping with the fields name, cuboid"):
        Part.from_record(record)


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.text(), inner, max_size=5),
    max_leaves=40,
)


@settings(deadline=None, max_examples=400)
@given(
    field=st.sampled_from(FIELDS),
    place=st.none() | st.tuples(st.integers(0, 1), st.integers(0, 2)),
    junk=JUNK,
)
def test_junk_in_a_field_or_a_number_is_refused_or_valid(field, place, junk):
    record = copy.deepcopy(RECORD)
    if place is None or field not in ("cuboid", "points"):
        record[field] = junk
    else:
        record[field][place[0]][place[1]] = junk
    try:
        part = Part.from_record(record)
    except UserError:
        return
    assert part.diameter > 0
    assert part.cuboid.shape == (9, 3)
    assert np.isfinite(part.cuboid).all()
    assert np.isfinite(part.points).all()
