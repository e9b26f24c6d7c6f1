import copy
import json

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from dopepp.core.errors import UserError
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.parts import Part, make_part, servoholder
from dopepp.parts.part import FIELDS, Mesh
from dopepp.parts.record import MAX_FACES, MAX_POINTS


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
    np.testing.assert_allclose(again.mesh.vertices[again.mesh.faces],
                               part.mesh.vertices[part.mesh.faces], atol=0.6e-7)  # fmt: skip
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


def test_a_record_of_an_earlier_version_has_no_mesh():
    part = Part.from_record({key: value for key, value in RECORD.items() if key != "mesh"})
    assert part.mesh is None
    assert part.to_record() == RECORD


def test_a_record_holds_few_triangles_and_says_how_far_they_are_off():
    sphere = trimesh.creation.icosphere(6, 0.05)  # 81,920 triangles
    light, deviation = make_part("ball", Mesh(sphere.vertices, sphere.faces)).light_mesh
    assert 2000 < len(light.faces) <= MAX_FACES
    told = trimesh.Trimesh(light.vertices, light.faces)
    points, _ = trimesh.sample.sample_surface(told, 300_000, seed=0)
    away = KDTree(points).query(sphere.vertices)[0].max()
    assert away - 0.0005 < deviation < 1.05 * away
    assert deviation < 0.001


TRIANGLE = {"vertices": [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], "faces": [[0, 1, 2]]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"deviation": -1}, "deviation -1"),
        ({"deviation": "0"}, "deviation '0'"),
        ({"faces": [[0, 1, 3]]}, "a face of other than its vertices; .*0 to 2"),
        ({"faces": [[0, 1, -1]]}, "0 to 2"),
        ({"faces": [[0, 1, 0.5]]}, "0 to 2"),
        ({"faces": []}, "mesh faces of 0 rows"),
        ({"faces": [[0, 1, 2]] * (MAX_FACES + 1)}, "mesh faces of 4001 rows"),
        ({"vertices": [[0, 0, 0]]}, "mesh vertices of 1 rows"),
        ({"vertices": [[0, 0, float("nan")]] * 3}, "no number of metres"),
        ({"texture": []}, "a mesh with other fields"),
    ],
)
def test_a_bad_mesh_is_named(change, message):
    with pytest.raises(UserError, match=message):
        Part.from_record({**RECORD, "mesh": {**TRIANGLE, "deviation": 0.0, **change}})


def test_no_symmetries_differ_from_unknown_ones():
    known = Part.from_record({**RECORD, "symmetries_discrete": []})
    assert known.symmetries_discrete is not None
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
        *(None, [], "record", 1, {}, {1: 2}, {**RECORD, "more": None}, [*RECORD.items()]),
        *[
            {key: RECORD[key] for key in RECORD if key != field}
            for field in FIELDS
            if field != "mesh"
        ],
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


@settings(max_examples=400)
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
