"""OBJ files: dialects, damage, and the texture that their materials name."""

import cv2
import numpy as np
import pytest

from dopepp.parts import read_mesh
from tests.parts.makers import solid_of

SQUARE = "v 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\n"
DART = "v 2 0 0\nv 0.5 0.5 0\nv 0 2 0\nv 0 0 0\n"
TEXTURED = f"mtllib a.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3 4/4\n"


def write_texture(path):
    """Write a PNG and return its RGB pixels: red over green, blue over white."""
    rgb = np.array([[[255, 0, 0], [0, 0, 255]], [[0, 255, 0], [255, 255, 255]]], np.uint8)
    assert cv2.imwrite(str(path), rgb[..., ::-1])
    return rgb


def test_dialects(write):
    text = (
        "# made by hand\r\no thing\r\nv\t0 0 0 1 1 1\r\nv 10 0 0 \r\nv 10 10 0\r\nv 0 10 0\r\n"
        "vn 0 0 1\r\ng side\r\ns off\r\nf -4//1 -3//1 \\\r\n -2//1\r\nf 1 3 4\r\nl 1 2\r\n"
    )
    loaded = read_mesh(write("m.OBJ", text), "mm")
    assert sorted(loaded.faces.tolist()) == [[0, 1, 2], [0, 2, 3]]
    np.testing.assert_allclose(np.ptp(loaded.vertices, axis=0), [0.01, 0.01, 0])


def test_a_concave_polygon_that_its_fan_fills_is_accepted(write):
    loaded = read_mesh(write("m.obj", DART + "f 4 1 2 3\n"), "m")  # the fan starts at 0 0 0
    assert solid_of(loaded).area == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SQUARE + "f -5 1 2\n", "index -5 among 4"),
        (SQUARE + "f 1/1 2/1 3/1\n", "index 1 among 0"),
        (SQUARE + "f a b c\n", "line 5 'f a b c'"),
        ("v 0 0\n", "line 1 'v 0 0' .*3 numbers"),
        ("v 0 0 x\n", "line 1 'v 0 0 x'"),
        (SQUARE + "v 1e999 0 0\nf 1 2 3\n", "not a finite number"),
        (DART + "f 1 2 3 4\n", "not convex in line 5; .* 'triangulate'"),
    ],
)
def test_a_damaged_line_is_named(refused, text, message):
    refused("m.obj", text, message)


@pytest.mark.parametrize("name", ["t.png", "maps/t.png", "maps\\t.png", "my texture ü.png"])
def test_texture_and_uv_are_read(tmp_path, write, name):
    (tmp_path / "maps").mkdir()
    rgb = write_texture(tmp_path / name.replace("\\", "/"))
    write("a.mtl", f"newmtl m\nKd 1 1 1\nmap_Kd {name} \n")
    loaded = read_mesh(write("m.obj", TEXTURED), "mm")
    np.testing.assert_array_equal(loaded.texture, rgb)
    np.testing.assert_allclose(loaded.vertices[:, :2], 0.1 * loaded.uv)


def test_a_vertex_on_a_seam_is_split(tmp_path, write):
    write_texture(tmp_path / "t.png")
    write("a.mtl", "newmtl m\nmap_Kd t.png\n")
    text = TEXTURED.replace("f 1/1 2/2 3/3 4/4", "f 1/1 2/2 3/3\nf 1/4 3/3 4/2")
    loaded = read_mesh(write("m.obj", text), "mm")
    assert len(loaded.vertices) == 5
    corners = np.concatenate([loaded.vertices, loaded.uv], axis=1)[loaded.faces]
    expected = [
        [[0, 0, 0, 0, 0], [0.1, 0, 0, 1, 0], [0.1, 0.1, 0, 1, 1]],
        [[0, 0, 0, 0, 1], [0.1, 0.1, 0, 1, 1], [0, 0.1, 0, 1, 0]],
    ]
    np.testing.assert_allclose(corners, expected)


@pytest.mark.parametrize(
    ("materials", "message"),
    [
        ("map_Kd gone.png\n", r"m\.obj whose map_Kd 'gone.png' does not exist"),
        ("map_Kd maps/../../out.png\n", r"map_Kd 'maps/\.\./\.\./out\.png' lies outside of its"),
        ("map_Kd C:\\out.png\n", "lies outside of its folder"),
        ("map_Kd \n", "does not exist"),
        ("map_Kd cut.png\n", r"texture .*cut\.png: .*a complete BMP, JPEG"),
        ("map_Kd cut.jpg\n", r"texture .*cut\.jpg: .*truncated"),
        ("map_Kd wide.png\n", r"8193×1 pixels; .*at most 8192×8192"),
        ("map_Kd a.mtl\n", r"texture .*a\.mtl: cannot identify"),
        ("map_Kd script.eps\n", r"texture .*script\.eps: cannot identify"),
        ("map_Kd -s 2 2 2 t.png\n", "map_Kd '-s 2 2 2 t.png'; .*without options"),
        ("newmtl m\n", "faces of 2 textures .*bake"),
        ("map_Kd t.png\n", "faces without texture coordinates"),
    ],
)
def test_a_bad_texture_is_refused(tmp_path, refused, materials, message):
    folder = tmp_path / "part"
    (folder / "maps").mkdir(parents=True)
    write_texture(tmp_path / "out.png")
    write_texture(folder / "t.png")
    (folder / "cut.png").write_bytes((folder / "t.png").read_bytes()[:-25])
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    (folder / "cut.jpg").write_bytes(cv2.imencode(".jpg", noise)[1].tobytes()[:2000])
    assert cv2.imwrite(str(folder / "wide.png"), np.zeros((1, 8_193), np.uint8))
    (folder / "script.eps").write_text(
        "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\nshowpage\n"
    )
    (folder / "a.mtl").write_text(f"newmtl n\nmap_Kd t.png\nnewmtl m\n{materials}")
    more = {"bake": "usemtl n\nf 1/1 2/2 3/3\n", "coordinates": "f 1 2 3\n"}
    added = next((lines for word, lines in more.items() if word in message), "")
    refused("part/m.obj", TEXTURED + added, message)


@pytest.mark.parametrize(
    ("library", "message"),
    [
        ("gone.mtl", "whose mtllib .*does not exist"),
        ("other.mtl", "uses the material 'm'; allowed: materials of other.mtl"),
    ],
)
def test_a_missing_material_file_or_material_is_named(write, refused, library, message):
    write("other.mtl", "newmtl other\nmap_Kd t.png\n")
    refused("m.obj", TEXTURED.replace("a.mtl", library), message)


def test_materials_without_a_texture_are_accepted(write):
    write("a.mtl", "newmtl m\nKd 1 0 0\nnewmtl other\nmap_Kd gone.png\n")
    loaded = read_mesh(write("m.obj", TEXTURED), "mm")
    assert loaded.texture is loaded.uv is None
