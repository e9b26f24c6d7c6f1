"""Files of grasps: what is written is read, and what is none is refused by name."""

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.parts.catalogue import BUILTIN, load_part
from dopepp.robot.grasping.grasps import WIDEST, Grasp, find_grasps, read_grasps, write_grasps

GOOD = "{point: [0, 0, 0], closing: [0, 1, 0], approach: [0, 0, -1], width: 0.05}"


@pytest.mark.parametrize("name", sorted(BUILTIN))
def test_built_in_parts_have_grasps_from_the_front(name):
    grasps = find_grasps(load_part(name))
    assert any(grasp.approach[2] < -0.9 for grasp in grasps)


def test_what_is_written_is_read(part, tmp_path):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    grasp = Grasp(np.array([0.01, -0.002, -3e-5]), turn[0], turn[1], 0.0333)
    write_grasps(tmp_path / "g.yaml", part, [grasp])
    (read,) = read_grasps(tmp_path / "g.yaml", part)
    for name in ("point", "closing", "approach", "width"):
        np.testing.assert_allclose(getattr(read, name), getattr(grasp, name), atol=2e-5)


@pytest.mark.parametrize("turned", [False, True])
def test_the_tool_closes_and_comes_as_the_grasp_says(turned):
    grasp = Grasp(np.array([0.1, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0]), 0.05)
    T = grasp.T_obj_tool(turned)
    np.testing.assert_allclose(T[:3, 0], [0, -1 if turned else 1, 0])
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert grasp.opening == pytest.approx(0.062)
    assert Grasp(grasp.point, grasp.closing, grasp.approach, 0.08).opening == WIDEST


def of(*grasps, part="pivconnector"):
    return f"{{part: {part}, grasps: [{', '.join(grasps)}]}}"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[]", "allowed: a mapping"),
        (of(GOOD, part="other"), "part: pivconnector"),
        (of(), "1 to 1000 grasps"),
        (of("3"), r"grasps\[0\]=3"),
        (of(GOOD, GOOD.replace("0.05", "0.2")), r"grasps\[1\].width=0.2"),
        (of(GOOD.replace("0.05", "-1")), "width=-1; allowed: a number from"),
        (of(GOOD.replace("0.05", "true")), "width=True"),
        (of(GOOD.replace("[0, 1, 0]", "[0, 1]")), "closing"),
        (of(GOOD.replace("[0, 1, 0]", "[0, 1, .nan]")), "nan"),
        (of(GOOD.replace("[0, 1, 0]", "[0, 0, 2]")), "right"),
        (of(GOOD.replace("[0, 1, 0]", "[0, 0, 0]")), "right"),
        (of(GOOD.replace("[0, 0, 0]", "[5, 0, 0]", 1)), "point"),
    ],
)
def test_what_is_no_file_of_grasps_is_refused_by_name(part, tmp_path, text, named):
    (tmp_path / "g.yaml").write_text(text)
    with pytest.raises(UserError, match=f"(?s).*{named}"):
        read_grasps(tmp_path / "g.yaml", part)


def test_a_part_without_grasps_is_told_how_to_get_some(part, tmp_path):
    from dataclasses import replace

    with pytest.raises(UserError, match="dopepp grasp propose bracket"):
        find_grasps(replace(part, name="bracket"))
