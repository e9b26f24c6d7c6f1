"""Files of grasps are written and read, and invalid files are rejected."""

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


def test_written_grasps_are_read(part, tmp_path):
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    grasp = Grasp(np.array([0.01, -0.002, -3e-5]), rotation[0], rotation[1], 0.0333)
    write_grasps(tmp_path / "g.yaml", part, [grasp])
    (read,) = read_grasps(tmp_path / "g.yaml", part)
    for name in ("point", "closing", "approach", "width"):
        np.testing.assert_allclose(getattr(read, name), getattr(grasp, name), atol=2e-5)


@pytest.mark.parametrize("flipped", [False, True])
def test_the_tool_has_the_axes_of_the_grasp(flipped):
    grasp = Grasp(np.array([0.1, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0]), 0.05)
    T = grasp.T_obj_tool(flipped)
    np.testing.assert_allclose(T[:3, 0], [0, -1 if flipped else 1, 0])
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert grasp.opening == pytest.approx(0.062)
    assert Grasp(grasp.point, grasp.closing, grasp.approach, 0.08).opening == WIDEST


def file_of(*grasps, part="pivconnector"):
    return f"{{part: {part}, grasps: [{', '.join(grasps)}]}}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "allowed: a mapping"),
        (file_of(GOOD, part="other"), "part: pivconnector"),
        (file_of(), "1 to 1000 grasps"),
        (file_of("3"), r"grasps\[0\]=3"),
        (file_of(GOOD, GOOD.replace("0.05", "0.2")), r"grasps\[1\].width=0.2"),
        (file_of(GOOD.replace("0.05", "-1")), "width=-1; allowed: a number from"),
        (file_of(GOOD.replace("0.05", "true")), "width=True"),
        (file_of(GOOD.replace("[0, 1, 0]", "[0, 1]")), "closing"),
        (file_of(GOOD.replace("[0, 1, 0]", "[0, 1, .nan]")), "nan"),
        (file_of(GOOD.replace("[0, 1, 0]", "[0, 0, 2]")), "right"),
        (file_of(GOOD.replace("[0, 1, 0]", "[0, 0, 0]")), "right"),
        (file_of(GOOD.replace("[0, 0, 0]", "[5, 0, 0]", 1)), "point"),
    ],
)
def test_an_invalid_file_is_rejected_with_the_field(part, tmp_path, text, message):
    (tmp_path / "g.yaml").write_text(text)
    with pytest.raises(UserError, match=f"(?s).*{message}"):
        read_grasps(tmp_path / "g.yaml", part)
