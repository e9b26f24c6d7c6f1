from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from trimesh.exchange.off import export_off
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl, export_stl_ascii

from dopepp.core.errors import UserError
from dopepp.parts import Mesh, load_part, read_mesh
from dopepp.parts.mesh import read as mesh

BOX = trimesh.creation.box((10.0, 20.0, 30.0))
FILES = {
    "binary.stl": export_stl(BOX),
    "text.STL": export_stl_ascii(BOX).encode(),
    "binary.ply": export_ply(BOX),
    "text.ply": export_ply(BOX, encoding="ascii"),
    "box.obj": trimesh.exchange.obj.export_obj(BOX).encode(),
    "box.off": export_off(BOX).encode(),
    "box.glb": BOX.export(file_type="glb"),
    "box.3mf": BOX.export(file_type="3mf"),
}
UNSTATED = [name for name in FILES if name not in ("box.glb", "box.3mf")]
SQUARE = "v 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\n"
TEXTURED = f"mtllib a.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3 4/4\n"
PLY_HEADER = (
    "ply\nformat ascii 1.0\n{comment}element vertex {vertices}\nproperty float x\n"
    "property float y\nproperty float z\n{uv}element face {faces}\n"
    "property list uchar int vertex_indices\nend_header\n"
)


def write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def write_texture(path: Path) -> np.ndarray:
    """Write a PNG and return its RGB pixels: red over green, blue over white."""
    rgb = np.array([[[255, 0, 0], [0, 0, 255]], [[0, 255, 0], [255, 255, 255]]], np.uint8)
    assert cv2.imwrite(str(path), rgb[..., ::-1])
    return rgb


def size(loaded: Mesh) -> np.ndarray:
    return np.ptp(loaded.vertices, axis=0)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    ("unit", "metres"), [("mm", 1e-3), ("cm", 1e-2), ("m", 1), ("inch", 0.0254)]
)
def test_every_format_and_unit_gives_the_same_box(
    tmp_path: Path, name: str, unit: str, metres: float
) -> None:
    loaded = read_mesh(write(tmp_path, name, FILES[name]), unit)
    np.testing.assert_allclose(size(loaded), metres * np.array([10, 20, 30]), rtol=1e-7)
    assert loaded.vertices.shape == (8, 3)
    assert loaded.vertices.dtype == np.float64
    assert loaded.faces.dtype == np.int32
    assert loaded.uv is None
    assert loaded.texture is None
    solid = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(6000 * metres**3, rel=1e-6)  # > 0: outward faces


@pytest.mark.parametrize("name", UNSTATED)
def test_millimetres_are_assumed_and_said(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = write(tmp_path, name, FILES[name])
    with caplog.at_level(logging.WARNING):
        stated = read_mesh(path, "mm")
        assert not caplog.records
        assumed = read_mesh(path)
    assert len(caplog.records) == 1
    assert f"{path} states no unit: taken as mm" in caplog.text
    np.testing.assert_array_equal(assumed.vertices, stated.vertices)


def test_several_solids_of_a_text_stl_are_one_mesh(tmp_path: Path) -> None:
    text = FILES["text.STL"].decode()
    loaded = read_mesh(write(tmp_path, "two.stl", text + "\n" + text.replace("30", "40")), "mm")
    assert len(loaded.faces) == 24


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_anywhere_is_never_half_a_mesh(tmp_path: Path, name: str) -> None:
    content = FILES[name].rstrip(b"\n")
    for length in [0, *np.linspace(1, len(content) - 2, 25).astype(int)]:
        path = write(tmp_path, name, content[:length])
        if name == "box.obj" and _ends_at_a_number(content, length):
            continue  # a shorter OBJ file that is whole in itself
        with pytest.raises(UserError, match=f"{name} with .* export the mesh again"):
            read_mesh(path, "mm")


def _ends_at_a_number(content: bytes, length: int) -> bool:
    whole = content[:length].split(b"\n")
    return any(line.startswith(b"f ") and len(line.split()) == 4 for line in whole)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb", "3mf"])
def test_noise_is_refused(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path, f"noise.{suffix}", np.random.default_rng(0).bytes(3000))
    with pytest.raises(UserError, match="noise"):
        read_mesh(path, "mm")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "3 vertices and 0 faces"),
        ("m.obj", "", "0 vertices and 0 faces"),
        ("m.obj", SQUARE + "f 1 2\n", "line 5 'f 1 2' .*3 corners"),
        ("m.obj", SQUARE + "f 1 2 5\n", "line 5 'f 1 2 5' .*index 5 among 4"),
        ("m.obj", SQUARE + "f 0 1 2\n", "index 0 among 4"),
        ("m.obj", SQUARE + "f -5 1 2\n", "index -5 among 4"),
        ("m.obj", SQUARE + "f 1/1 2/1 3/1\n", "index 1 among 0"),
        ("m.obj", SQUARE + "f a b c\n", "line 5 'f a b c'"),
        ("m.obj", "v 0 0\n", "line 1 'v 0 0' .*3 numbers"),
        ("m.obj", "v 0 0 x\n", "line 1 'v 0 0 x'"),
        ("m.obj", SQUARE + "v nan 0 0\nf 1 2 3\n", "not a finite number"),
        ("m.obj", SQUARE + "v 1e999 0 0\nf 1 2 3\n", "not a finite number"),
        ("m.obj", SQUARE + "f 1 1 2\nf 3 3 3\n", "2 faces, none with an area"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "1 faces, none with an area"),
        (
            "m.obj",
            "v 2 0 0\nv 0.5 0.5 0\nv 0 2 0\nv 0 0 0\nf 1 2 3 4\n",
            "not convex in line 5; .* 'triangulate'",
        ),
        ("m.stl", "solid a\nendsolid a\n", "0 vertices and 0 faces"),
        ("m.stl", export_stl_ascii(BOX).replace("-5", "nan", 1), "m.stl with"),
        ("m.stl", export_stl_ascii(BOX).replace("vertex", "vertex x", 1), "m.stl with"),
        (
            "m.stl",
            export_stl_ascii(BOX) + "\n" + export_stl_ascii(BOX)[:700],
            "facets begun and 12 ended",
        ),
        (
            "m.ply",
            PLY_HEADER.format(comment="", uv="", vertices=3, faces=1)
            + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7",
            "a face index outside of its 3 vertices",
        ),
        (
            "m.ply",
            PLY_HEADER.format(comment="", uv="", vertices=10**12, faces=10**12) + "0 0 0\n" * 9,
            "less data than 1000000000000 rows of element vertex",
        ),
        (
            "m.ply",
            PLY_HEADER.format(comment="", uv="", vertices=3, faces=0) + "0 0 0\n1 0 0\n0 1 0\n",
            "m.ply with",
        ),
    ],
)
def test_what_is_no_mesh_is_refused(tmp_path: Path, name: str, content: str, message: str) -> None:
    path = write(tmp_path, name, content)
    with pytest.raises(UserError, match=message) as caught:
        read_mesh(path, "mm")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_path_or_unit_that_cannot_be_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path, "box.stl", FILES["binary.stl"])
    with pytest.raises(UserError, match=r"gone\.stl, no such file"):
        read_mesh(tmp_path / "gone.stl")
    with pytest.raises(
        UserError, match=r"box\.step; allowed: files ending in \.stl, \.obj, \.ply, \.glb, "
    ):
        read_mesh(tmp_path / "box.step")
    with pytest.raises(UserError, match=r"unit='feet' .*; allowed: mm, cm, m, inch"):
        read_mesh(path, "feet")
    (tmp_path / "folder.stl").mkdir()
    with pytest.raises(UserError, match="no such file"):
        read_mesh(tmp_path / "folder.stl")
    monkeypatch.setattr(mesh, "MAX_BYTES", 600)
    with pytest.raises(UserError, match="fix: reduce its triangles"):
        read_mesh(path)


def test_flat_triangles_are_dropped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = SQUARE + "v 50 0 0\nv 7 7 7\nf 1 2 3 4\nf 1 2 5\nf 1 1 2\nf 6 6 6\n"
    with caplog.at_level(logging.INFO):
        loaded = read_mesh(write(tmp_path, "m.obj", text), "mm")
    assert "dropped 3 triangles without area" in caplog.text
    assert len(loaded.faces) == 2
    assert len(loaded.vertices) == 4  # the two that only flat triangles used are gone
    np.testing.assert_allclose(size(loaded), [0.1, 0.1, 0])


def test_obj_dialects(tmp_path: Path) -> None:
    text = (
        "# made by hand\r\no thing\r\nv\t0 0 0 1 1 1\r\nv 10 0 0 \r\nv 10 10 0\r\nv 0 10 0\r\n"
        "vn 0 0 1\r\ng side\r\ns off\r\nf -4//1 -3//1 \\\r\n -2//1\r\nf 1 3 4\r\nl 1 2\r\n"
    )
    loaded = read_mesh(write(tmp_path, "m.OBJ", text), "mm")
    assert sorted(loaded.faces.tolist()) == [[0, 1, 2], [0, 2, 3]]
    np.testing.assert_allclose(size(loaded), [0.01, 0.01, 0])


def test_a_concave_polygon_whose_fan_fills_it_is_taken(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 2 0 0\nv 0.5 0.5 0\nv 0 2 0\nf 1 2 3 4\n"  # the fan starts at 0 0 0
    loaded = read_mesh(write(tmp_path, "m.obj", text), "m")
    assert trimesh.Trimesh(loaded.vertices, loaded.faces, process=False).area == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["t.png", "maps/t.png", "maps\\t.png", "my texture ü.png"])
def test_texture_and_uv_are_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "maps").mkdir()
    rgb = write_texture(tmp_path / name.replace("\\", "/"))
    write(tmp_path, "a.mtl", f"newmtl m\nKd 1 1 1\nmap_Kd {name} \n")
    loaded = read_mesh(write(tmp_path, "m.obj", TEXTURED), "mm")
    assert loaded.uv is not None
    assert loaded.texture is not None
    np.testing.assert_array_equal(loaded.texture, rgb)
    np.testing.assert_allclose(loaded.vertices[:, :2], 0.1 * loaded.uv)


def test_a_vertex_on_a_seam_is_split(tmp_path: Path) -> None:
    write_texture(tmp_path / "t.png")
    write(tmp_path, "a.mtl", "newmtl m\nmap_Kd t.png\n")
    text = TEXTURED.replace("f 1/1 2/2 3/3 4/4", "f 1/1 2/2 3/3\nf 1/4 3/3 4/2")
    loaded = read_mesh(write(tmp_path, "m.obj", text), "mm")
    assert len(loaded.vertices) == 5
    assert loaded.uv is not None
    corners = np.concatenate([loaded.vertices, loaded.uv], axis=1)[loaded.faces]
    expected = [
        [[0, 0, 0, 0, 0], [0.1, 0, 0, 1, 0], [0.1, 0.1, 0, 1, 1]],
        [[0, 0, 0, 0, 1], [0.1, 0.1, 0, 1, 1], [0, 0.1, 0, 1, 0]],
    ]
    np.testing.assert_allclose(corners, expected)


def test_a_ply_texture_is_read(tmp_path: Path) -> None:
    rgb = write_texture(tmp_path / "t.png")
    header = PLY_HEADER.format(
        comment="comment TextureFile t.png\n",
        uv="property float texture_u\nproperty float texture_v\n",
        vertices=3,
        faces=1,
    )
    body = "0 0 0 0 0\n100 0 0 1 0\n0 100 0 0 1\n3 0 1 2\n"
    loaded = read_mesh(write(tmp_path, "m.ply", header + body), "mm")
    assert loaded.uv is not None
    assert loaded.texture is not None
    np.testing.assert_array_equal(loaded.texture, rgb)
    np.testing.assert_allclose(loaded.vertices[:, :2], 0.1 * loaded.uv, atol=1e-9)
    for name, message in (("gone.png", "does not exist"), ("../t.png", "outside of its folder")):
        path = write(tmp_path, "bad.ply", header.replace("t.png", name) + body)
        with pytest.raises(UserError, match=f"TextureFile '{name}' {message}|{message}"):
            read_mesh(path, "mm")


def test_a_ply_texture_without_coordinates_is_refused(tmp_path: Path) -> None:
    write_texture(tmp_path / "t.png")
    header = PLY_HEADER.format(comment="comment TextureFile t.png\n", uv="", vertices=3, faces=1)
    path = write(tmp_path, "m.ply", header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(UserError, match="1 textures, no uv"):
        read_mesh(path, "mm")


@pytest.mark.parametrize(
    ("materials", "message"),
    [
        ("newmtl m\nmap_Kd gone.png\n", r"m\.obj whose map_Kd 'gone.png' does not exist"),
        ("newmtl m\nmap_Kd ../out.png\n", r"map_Kd '\.\./out\.png' lies outside of its folder"),
        ("newmtl m\nmap_Kd maps/../../out.png\n", "lies outside of its folder"),
        ("newmtl m\nmap_Kd {root}/out.png\n", "lies outside of its folder"),
        ("newmtl m\nmap_Kd C:\\out.png\n", "lies outside of its folder"),
        ("newmtl m\nmap_Kd link.png\n", "lies outside of its folder"),
        ("newmtl m\nmap_Kd \n", "does not exist"),
        ("newmtl m\nmap_Kd cut.png\n", r"texture .*cut\.png: .*a whole BMP, JPEG"),
        ("newmtl m\nmap_Kd a.mtl\n", r"texture .*a\.mtl: cannot identify"),
        ("newmtl m\nmap_Kd script.eps\n", r"texture .*script\.eps: cannot identify"),
        ("newmtl m\nmap_Kd -s 2 2 2 t.png\n", "map_Kd '-s 2 2 2 t.png'; .*without options"),
        ("newmtl other\nmap_Kd t.png\n", "uses the material 'm'; allowed: materials of a.mtl"),
    ],
)
def test_a_bad_texture_is_refused(tmp_path: Path, materials: str, message: str) -> None:
    folder = tmp_path / "part"
    (folder / "maps").mkdir(parents=True)
    write_texture(tmp_path / "out.png")
    write_texture(folder / "t.png")
    (folder / "link.png").symlink_to(tmp_path / "out.png")
    write(folder, "cut.png", (folder / "t.png").read_bytes()[:-25])
    write(folder, "script.eps", "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\nshowpage\n")
    write(folder, "a.mtl", materials.replace("{root}", str(tmp_path)))
    path = write(folder, "m.obj", TEXTURED)
    with pytest.raises(UserError, match=message) as caught:
        read_mesh(path, "mm")
    assert "\n" not in str(caught.value)


def test_a_jpeg_cut_in_the_middle_is_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    assert cv2.imwrite(str(tmp_path / "t.jpg"), noise)
    write(tmp_path, "t.jpg", (tmp_path / "t.jpg").read_bytes()[:2000])
    write(tmp_path, "a.mtl", "newmtl m\nmap_Kd t.jpg\n")
    with pytest.raises(UserError, match=r"texture .*t\.jpg: .*truncated"):
        read_mesh(write(tmp_path, "m.obj", TEXTURED), "mm")


def test_a_texture_of_absurd_size_is_refused(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "t.png"), np.zeros((1, 8_193), np.uint8))
    write(tmp_path, "a.mtl", "newmtl m\nmap_Kd t.png\n")
    with pytest.raises(UserError, match=r"8193×1 pixels; .*at most 8192×8192"):
        read_mesh(write(tmp_path, "m.obj", TEXTURED), "mm")


@pytest.mark.parametrize("library", ["gone.mtl", "../a.mtl"])
def test_a_material_file_must_be_in_the_folder(tmp_path: Path, library: str) -> None:
    (tmp_path / "part").mkdir()
    write(tmp_path, "a.mtl", "newmtl m\n")
    path = write(tmp_path / "part", "m.obj", TEXTURED.replace("a.mtl", library))
    with pytest.raises(UserError, match=r"whose mtllib .*(does not exist|outside of its folder)"):
        read_mesh(path, "mm")


def test_materials_without_a_texture_are_fine(tmp_path: Path) -> None:
    write(tmp_path, "a.mtl", "newmtl m\nKd 1 0 0\nnewmtl other\nmap_Kd gone.png\n")
    loaded = read_mesh(write(tmp_path, "m.obj", TEXTURED), "mm")
    assert loaded.texture is None
    assert loaded.uv is None


def test_one_texture_must_cover_all_faces(tmp_path: Path) -> None:
    write_texture(tmp_path / "t.png")
    write(tmp_path, "a.mtl", "newmtl m\nmap_Kd t.png\nnewmtl n\nKd 1 1 1\n")
    mixed = write(tmp_path, "mixed.obj", TEXTURED + "usemtl n\nf 1/1 2/2 3/3\n")
    with pytest.raises(UserError, match=r"faces of 2 textures .*bake"):
        read_mesh(mixed, "mm")
    bare = write(tmp_path, "bare.obj", TEXTURED + "f 1 2 3\n")
    with pytest.raises(UserError, match="faces without texture coordinates"):
        read_mesh(bare, "mm")


def test_load_part_by_name_and_by_path(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert load_part("servoholder").name == "servoholder"
    assert load_part("pivconnector", "inch") is load_part("pivconnector")  # unit is for files
    path = write(tmp_path, "My_Box.stl", FILES["binary.stl"])
    assert load_part(path).name == "My_Box"
    assert "taken as mm" in caplog.text
    assert load_part(str(path), "cm").diameter == pytest.approx(np.sqrt(0.14))


def test_load_part_refuses_what_it_cannot_find(tmp_path: Path) -> None:
    with pytest.raises(
        UserError,
        match=r"unknown part 'servo'; allowed: servoholder, pivconnector, .*\.stl/\.obj/\.ply",
    ):
        load_part("servo")
    with pytest.raises(UserError, match="no such file"):
        load_part(tmp_path / "gone.stl")


def test_millimetres_read_as_metres_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "box.stl", FILES["binary.stl"])
    with pytest.raises(UserError, match=r"'box' with a diameter of 37\.42 m, .*unit=m; .*unit=mm"):
        load_part(path, "m")
