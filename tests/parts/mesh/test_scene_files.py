"""GLB, 3MF and OFF files: what is read of them, and what is refused."""

from __future__ import annotations

import io
import json
import logging
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.exchange.off import export_off

from dopepp.core.errors import UserError
from dopepp.parts import Mesh, load_part, read_mesh
from dopepp.parts.mesh.library import UNITS_3MF

BOX = trimesh.creation.box((10.0, 20.0, 30.0))
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
TURN = trimesh.transformations.rotation_matrix(0.3, [1, 2, 3], [4, 5, 6])


def write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def exported(mesh: trimesh.Trimesh | trimesh.Scene, kind: str) -> bytes:
    return bytes(mesh.export(file_type=kind))


def edited(content: bytes, edit: Callable[[dict[str, Any]], object]) -> bytes:
    """Change the JSON of a GLB file."""
    size = int.from_bytes(content[12:16], "little")
    header = json.loads(content[20 : 20 + size])
    edit(header)
    text = json.dumps(header).encode()
    rest = content[20 + size :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    return head + text + rest


def repacked(content: bytes, edit: Callable[[bytes], bytes]) -> bytes:
    """Change the root model of a 3MF file."""
    file = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(content)) as source,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for name in source.namelist():
            data = source.read(name)
            target.writestr(name, edit(data) if name.endswith(".model") else data)
    return file.getvalue()


def textured_square(size: float = 0.1) -> trimesh.Trimesh:
    """A square whose texture, 2×2 pixels, shows at its corners."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    picture = Image.fromarray(np.arange(12, dtype=np.uint8).reshape(2, 2, 3))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    return trimesh.Trimesh(
        size * np.column_stack([corners, np.zeros(4)]),
        [[0, 1, 2], [0, 2, 3]],
        visual=trimesh.visual.TextureVisuals(uv=corners, material=material),
        process=False,
    )


def ordered(points: np.ndarray) -> np.ndarray:
    return np.asarray(points[np.lexsort(np.round(points, 4).T)])


def volume(mesh: Mesh) -> float:
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_volume
    return float(solid.volume)


# GLB


def test_a_glb_file_is_in_metres_and_another_unit_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    small = BOX.copy()
    small.apply_scale(0.001)
    path = write(tmp_path, "box.glb", exported(small, "glb"))
    with caplog.at_level(logging.INFO):
        np.testing.assert_allclose(np.ptp(read_mesh(path).vertices, axis=0), [0.01, 0.02, 0.03])
        assert load_part(path).diameter == pytest.approx(np.sqrt(1400) / 1000)
        assert not caplog.records
    assert np.ptp(read_mesh(path, "cm").vertices) == pytest.approx(0.0003)
    assert f"{path} is in m by its format: taken as cm, as asked" in caplog.text
    with pytest.raises(UserError, match=r"37\.42 m, its file read with unit=m; .*unit=mm"):
        load_part(write(tmp_path, "large.glb", exported(BOX, "glb")))


def test_a_glb_scene_is_one_mesh_where_its_nodes_are(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(BOX, transform=TURN)
    scene.add_geometry(BOX, transform=np.diag([1, 1, -2, 1]))
    scene.add_geometry(trimesh.load_path(np.array([[[0, 0, 0], [99, 0, 0]]])))
    loaded = read_mesh(write(tmp_path, "two.glb", exported(scene, "glb")), "mm")
    # The line is left out, and the mirrored box faces outwards.
    expected = [trimesh.transform_points(BOX.vertices, TURN), BOX.vertices * [1, 1, -2]]
    np.testing.assert_allclose(
        ordered(1000 * loaded.vertices), ordered(np.concatenate(expected)), atol=1e-5
    )
    assert volume(loaded) == pytest.approx(3 * 6e-6, rel=1e-6)


def test_a_glb_file_has_one_hash(tmp_path: Path) -> None:
    """trimesh gives the pieces of one mesh random names."""

    def edit(header: dict[str, Any]) -> None:
        primitive = header["meshes"][0]["primitives"][0]
        header["meshes"][0]["primitives"] = [primitive, primitive | {"mode": 5}, primitive]

    path = write(tmp_path, "a.glb", edited(exported(BOX, "glb"), edit))
    assert len({load_part(path, "mm").mesh_hash for _ in range(5)}) == 1


def test_a_glb_texture_lies_as_that_of_an_obj_file(tmp_path: Path) -> None:
    square = textured_square()
    loaded = read_mesh(write(tmp_path, "a.glb", exported(square, "glb")))
    assert loaded.uv is not None
    np.testing.assert_array_equal(loaded.texture, square.visual.material.baseColorTexture)
    np.testing.assert_allclose(loaded.vertices[:, :2], 0.1 * loaded.uv, atol=1e-7)
    square.export(tmp_path / "a.obj")
    same = read_mesh(tmp_path / "a.obj", "m")
    assert same.uv is not None
    np.testing.assert_array_equal(loaded.texture, same.texture)
    np.testing.assert_allclose(loaded.uv[loaded.faces], same.uv[same.faces], atol=1e-7)


def set_info(**info: Any) -> Callable[[dict[str, Any]], object]:
    def edit(header: dict[str, Any]) -> None:
        header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] |= info

    return edit


def set_array(name: str, **fields: Any) -> Callable[[dict[str, Any]], object]:
    def edit(header: dict[str, Any]) -> None:
        primitive = header["meshes"][0]["primitives"][0]
        index = primitive["indices"] if name == "indices" else primitive["attributes"][name]
        header["accessors"][index] |= fields

    return edit


def set_primitive(**fields: Any) -> Callable[[dict[str, Any]], object]:
    return lambda header: header["meshes"][0]["primitives"][0].update(fields)


GLB_CASES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "a moved texture": (
        set_info(extensions={"KHR_texture_transform": {"scale": [2, 2]}}),
        "a texture with a transform",
    ),
    "other coordinates": (set_info(texCoord=1), "second texture coordinates"),
    "coordinates in bytes": (
        set_array("TEXCOORD_0", componentType=5121, normalized=True),
        "coordinates that are floats",
    ),
    "sparse positions": (
        set_array("POSITION", sparse={"count": 1, "indices": {}, "values": {}}),
        "compressed, sparse or left out",
    ),
    "a fan": (set_primitive(mode=6), "a fan of triangles"),
    "a quantised mesh": (
        lambda header: header.update(extensionsRequired=["KHR_mesh_quantization"]),
        "the extension KHR_mesh_quantization",
    ),
    "a node in two places": (
        lambda header: header.update(
            nodes=[{"children": [1]}, {"mesh": 0}, {"children": [1], "scale": [2, 2, 2]}],
            scenes=[{"nodes": [0, 2]}],
        ),
        "a node in two places",
    ),
}


@pytest.mark.parametrize("name", GLB_CASES)
def test_what_trimesh_passes_over_in_a_glb_file_is_refused(tmp_path: Path, name: str) -> None:
    edit, message = GLB_CASES[name]
    path = write(tmp_path, "a.glb", edited(exported(textured_square(), "glb"), edit))
    trimesh.load_scene(path)  # without a word
    with pytest.raises(UserError, match=message) as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value)


def test_texture_coordinates_must_be_as_many_as_vertices(tmp_path: Path) -> None:
    content = edited(exported(textured_square(), "glb"), set_array("TEXCOORD_0", count=3))
    with pytest.raises(UserError, match="3 texture coordinates of 4 vertices"):
        read_mesh(write(tmp_path, "a.glb", content))


def test_one_texture_must_cover_a_glb_file(tmp_path: Path) -> None:
    scene = trimesh.Scene([textured_square(), BOX])
    with pytest.raises(UserError, match=r"faces of 2 textures; .* bake"):
        read_mesh(write(tmp_path, "a.glb", exported(scene, "glb")))


def test_a_glb_file_without_its_data_is_cut_short(tmp_path: Path) -> None:
    content = exported(BOX, "glb")
    end = 20 + int.from_bytes(content[12:16], "little")
    path = write(tmp_path, "a.glb", content[:8] + struct.pack("<I", end) + content[12:end])
    with pytest.raises(UserError, match=r"a\.glb with error: unpack_from"):
        read_mesh(path)
    short = content[:end] + struct.pack("<I", 4) + b"BIN\0" + bytes(4)
    path = write(tmp_path, "b.glb", short[:8] + struct.pack("<I", len(short)) + short[12:])
    with pytest.raises(UserError, match=r"b\.glb with"):
        read_mesh(path)


# 3MF


@pytest.mark.parametrize("unit", UNITS_3MF)
def test_a_3mf_file_states_its_unit(
    tmp_path: Path, unit: str, caplog: pytest.LogCaptureFixture
) -> None:
    metres = {"millimeter": 1e-3, "centimeter": 1e-2, "meter": 1, "inch": 0.0254}[unit]
    content = repacked(
        exported(BOX, "3mf"), lambda model: model.replace(b"millimeter", unit.encode())
    )
    path = write(tmp_path, "box.3mf", content)
    loaded = read_mesh(path)
    np.testing.assert_allclose(np.ptp(loaded.vertices, axis=0), metres * np.array([10, 20, 30]))
    assert volume(loaded) == pytest.approx(6000 * metres**3)
    assert not caplog.records
    if unit != "inch":
        read_mesh(path, "inch")
        assert f"is in {UNITS_3MF[unit]} by its format: taken as inch" in caplog.text


def test_a_3mf_file_in_no_unit_is_in_millimetres_and_in_feet_is_refused(tmp_path: Path) -> None:
    content = exported(BOX, "3mf")
    bare = repacked(content, lambda model: model.replace(b'unit="millimeter"', b""))
    loaded = read_mesh(write(tmp_path, "bare.3mf", bare))
    np.testing.assert_allclose(np.ptp(loaded.vertices, axis=0), [0.01, 0.02, 0.03])
    feet = repacked(content, lambda model: model.replace(b"millimeter", b"foot"))
    with pytest.raises(UserError, match=r"the unit 'foot'; allowed: millimeter, .*millimetres"):
        read_mesh(write(tmp_path, "feet.3mf", feet))


def test_a_3mf_build_is_one_mesh_where_it_puts_its_objects(tmp_path: Path) -> None:
    def transform(x: float) -> str:
        return f'transform="1 0 0 0 0 1 0 -1 0 {x} 0 7"'

    def assemble(model: bytes) -> bytes:
        text = re.sub(r"<build.*</build>", "<build>@</build>", model.decode(), flags=re.DOTALL)
        number = re.findall(r'<object[^>]*\bid="(\d+)"', text)[0]
        arm = f'<component objectid="{number}"/><component objectid="{number}" {transform(40)}/>'
        text = text.replace(
            "</resources>", f'<object id="99"><components>{arm}</components></object></resources>'
        )
        items = f'<item objectid="99" {transform(100)}/><item objectid="{number}"/>'
        return text.replace("@", items).encode()

    path = write(tmp_path, "three.3mf", repacked(exported(BOX, "3mf"), assemble))
    loaded = read_mesh(path)
    assert volume(loaded) == pytest.approx(3 * 6e-6)
    # A 3MF row is a column of ours: a quarter turn about x, then a shift.
    T = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 7], [0, 0, 0, 1.0]])
    places = []
    for matrix in (
        np.eye(4),
        T + 100 * np.eye(4, k=3),
        (T + 100 * np.eye(4, k=3)) @ (T + 40 * np.eye(4, k=3)),
    ):
        places.append(trimesh.transform_points(BOX.vertices, matrix))
    np.testing.assert_allclose(
        ordered(1000 * loaded.vertices), ordered(np.concatenate(places)), atol=1e-9
    )


def test_a_3mf_model_that_ends_too_early_is_refused(tmp_path: Path) -> None:
    content = exported(BOX, "3mf")
    size = len(repacked(content, lambda model: model))
    for length in range(500, size, 97):
        path = write(tmp_path, "a.3mf", repacked(content, lambda model, n=length: model[:n]))
        with pytest.raises(UserError, match=r"a\.3mf with .*export the mesh again"):
            read_mesh(path)


# OFF


def off(faces: list[list[int]], vertices: np.ndarray = BOX.vertices) -> str:
    rows = [" ".join(map(str, row)) for row in vertices.tolist()]
    rows += [" ".join(map(str, [len(face), *face])) for face in faces]
    return f"OFF\n{len(vertices)} {len(faces)} 0\n" + "\n".join(rows) + "\n"


def test_off_polygons_and_dialects(tmp_path: Path) -> None:
    mixed = [*QUADS[:3], [2, 3, 7], [2, 7, 6], *QUADS[4:]]
    text = off(mixed)
    for number, dialect in enumerate([
        text, off(BOX.faces.tolist()), off(QUADS), export_off(BOX),
        text.replace("\n", "\r\n"), text.replace("OFF\n", "OFF"),
        "# a box\n\n" + text.replace("9 0\n", "9 0 # counts\n\n"),
        text.replace("3 2 3 7", "3 2 3 7 255 0 0"),
    ]):  # fmt: skip
        loaded = read_mesh(write(tmp_path, f"{number}.off", dialect), "mm")
        assert volume(loaded) == pytest.approx(6e-6)
        assert len(loaded.faces) == 12


def test_a_prism_of_hexagons_in_an_off_file(tmp_path: Path) -> None:
    angle = np.arange(6) * np.pi / 3
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(6)], axis=1)
    sides = [[i, (i + 1) % 6, 6 + (i + 1) % 6, 6 + i] for i in range(6)]
    faces = [[5, 4, 3, 2, 1, 0], *sides, [6, 7, 8, 9, 10, 11]]
    vertices = np.concatenate([ring, ring + np.array([0, 0, 2])])
    loaded = read_mesh(write(tmp_path, "a.off", off(faces, vertices)), "cm")
    assert volume(loaded) == pytest.approx(3 * np.sqrt(3) * 1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (off(QUADS).replace("8 6", "8 5"), "14 lines where its header promises 8 .* 5 faces"),
        (off(QUADS).replace("8 6", "8 7"), "14 lines where its header promises 8 .* 7 faces"),
        (off(QUADS).replace("4 0 1 3 2", "4 0 1 3"), "face 0 of 4 corners, 3 in its line"),
        (off(QUADS).replace("4 0 1 3 2", "2 0 1"), "face 0 of fewer than 3 corners"),
        (off(QUADS).replace("4 0 1 3 2", "4 0 1 3 8"), "a face index outside of its 8"),
        (off(QUADS).replace("4 0 1 3 2", "4 0 1 3 1.5"), "invalid literal"),
        (off([[0, 3, 1, 2], *QUADS[1:]]), "a polygon that is not convex, face 0"),
        (off(QUADS).replace("OFF", "4OFF"), "no OFF header"),
        (off(QUADS).replace("-5.0", "five", 1), "could not convert"),
        (off(QUADS).replace("-5.0", "nan", 1), "not a finite number, vertex 1"),
    ],
)
def test_a_damaged_off_file_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        read_mesh(write(tmp_path, "a.off", text), "mm")
    assert "\n" not in str(caught.value)
