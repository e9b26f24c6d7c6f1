"""STL, GLB and 3MF files read by trimesh, and files that trimesh reads wrongly."""

import io
import json
import logging
import re
import struct
import zipfile

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl, export_stl_ascii

from dopepp.core.errors import UserError
from dopepp.parts import load_part, read_mesh
from dopepp.parts.mesh.library import UNITS_3MF

BOX = trimesh.creation.box((10.0, 20.0, 30.0))
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
TURN = trimesh.transformations.rotation_matrix(0.3, [1, 2, 3], [4, 5, 6])


def obj(faces, before=""):
    return f"{before}v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\n{faces}"


def ply_faces(*faces):
    header = export_ply(BOX).split(b"end_header")[0]
    header = re.sub(rb"element face \d+", b"element face %d" % len(faces), header)
    rows = [struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces]
    return header + b"end_header\n" + BOX.vertices.astype("<f4").tobytes() + b"".join(rows)


OFF = "OFF\n8 6 0\n" + "".join(f"{x} {y} {z}\n" for x, y, z in BOX.vertices.tolist())
OFF += "".join(f"4 {' '.join(map(str, face))}\n" for face in QUADS)
TEXT_PLY = export_ply(BOX, encoding="ascii")
PENTAGON_AND_TRIANGLE = [*QUADS[:2], [0, 4, 5, 1, 0], [2, 3, 7]]
"""The last two faces have as many bytes as two quads."""
HEXAGON = "v 2 0 0\nv 1 2 0\nv -1 2 0\nv -2 0 0\nv -1 -2 0\nv 1 -2 0\nvt 0 0\n"

WRONG = {
    # A file, trimesh's number of triangles (-1: refused), and our number or error message.
    "cut.ply": (TEXT_PLY[: TEXT_PLY.rindex(b"\n3 ")], 11, "less data|buffer is smaller"),
    "count.ply": (TEXT_PLY.replace(b"\n3 7", b"\n2 7"), 12, "fewer than 3|bytes more"),
    "fraction.ply": (TEXT_PLY.replace(b"3 1 3 0", b"3 1 3 0.5"), 12, "not an integer"),
    "mixed.ply": (ply_faces(*QUADS[:3], [2, 3, 7], [2, 7, 6], *QUADS[4:]), -1, 12),
    "agree.ply": (ply_faces(*PENTAGON_AND_TRIANGLE), 8, 7),
    "line_ends.ply": (TEXT_PLY.replace(b"\n", b"\r"), -1, 12),
    "cut.obj": (obj("f 1 2 3\nf 1 3\n"), 1, "line 8 'f 1 3' .*3 corners"),
    "zero.obj": (obj("f 0 2 3\n"), 1, "index 0 among 4"),
    "outside.obj": (obj("f 1 2 3\nf 1 2 5\n"), -1, "index 5 among 4"),
    "tab.obj": (obj("f 1 2 3\nf\t1 3 4\n"), 1, 2),
    "hexagon.obj": (HEXAGON + "f 1/1 2/1 3/1\nf 1 2 3 4 5 6\n", 2, 5),
    "library.obj": (obj("usemtl m\nf 1/1 2/2 3/1\n", "mtllib gone.mtl\n"), 1, "does not exist"),
    "cut.stl": (export_stl_ascii(BOX) + export_stl_ascii(BOX)[:900], 12, "begun and 12 ended"),
    "cut.off": (OFF.rsplit("\n", 2)[0], 10, "13 lines"),
    "pentagon.off": (OFF.replace("4 1 5 7 3", "5 1 5 7 3 1"), -1, 12),
    "short.off": (OFF.replace("4 0 1 3 2", "4 0 1 3"), 11, "face 0 with 3 instead of 4 corners"),
}


@pytest.mark.parametrize(
    ("name", "content", "theirs", "ours"),
    [(name, *case) for name, case in WRONG.items()],
    ids=WRONG,
)
def test_files_that_trimesh_reads_wrongly(write, refused, name, content, theirs, ours):
    """If a case fails, trimesh has been corrected, and our check or reader can be removed."""
    path = write(name, content)
    try:
        num_theirs = len(trimesh.load_mesh(path, process=False).faces)
    except Exception:
        num_theirs = -1
    assert num_theirs == theirs
    if isinstance(ours, str):
        refused(name, content, ours)
    else:
        assert len(read_mesh(path, "cm").faces) == ours


def test_trimesh_puts_the_triangles_of_quads_in_another_order(write):
    """The order changes a mesh's hash, which identifies it in checkpoints and render caches."""
    path = write("a.ply", ply_faces(*QUADS))
    theirs, ours = trimesh.load_mesh(path, process=False).faces, read_mesh(path, "mm").faces
    assert ours[:2].tolist() == [[0, 1, 3], [0, 3, 2]]
    assert theirs.tolist() != ours.tolist()


@pytest.mark.parametrize("count", [0, 1, 11, 13, 10**9, 2**32 - 1])
def test_a_binary_stl_with_a_wrong_count_is_refused(refused, count):
    binary = export_stl(BOX)
    lie = binary[:80] + struct.pack("<I", count) + binary[84:]
    refused("a.stl", lie, rf"684 bytes, but the header states {count} triangles")


def test_a_binary_stl_may_begin_like_text(write):
    path = write("a.stl", b"solid part".ljust(80) + export_stl(BOX)[80:])
    assert len(read_mesh(path, "mm").faces) == 12


def test_layouts_of_text_stl_files(write):
    text = export_stl_ascii(BOX)
    for num_faces, dialect in (
        (12, text.upper()),
        (12, text.replace("\n", "\r\n")),
        (12, text.replace("facet normal", "facet \t normal").replace("vertex", "  vertex ")),
        (12, "\n" + text.replace("endsolid", "endsolid of a facet")),
        (24, text + "\n" + text.replace("30", "40")),
    ):
        assert len(read_mesh(write("a.stl", dialect), "mm").faces) == num_faces


@pytest.mark.parametrize(("old", "new"), [("-5", "nan"), ("vertex", "vertex x")])
def test_a_text_stl_without_numbers_is_refused(refused, old, new):
    refused("m.stl", export_stl_ascii(BOX).replace(old, new, 1), "m.stl with")


def exported(mesh, kind):
    return bytes(mesh.export(file_type=kind))


GLB, BOX_3MF = exported(BOX, "glb"), exported(BOX, "3mf")


def edited(content, edit):
    """Change the JSON of a GLB file."""
    size = int.from_bytes(content[12:16], "little")
    header = json.loads(content[20 : 20 + size])
    edit(header)
    text = json.dumps(header).encode()
    rest = content[20 + size :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    return head + text + rest


def repacked(content, edit):
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


def textured_square(size=0.1):
    """A square whose texture, 2×2 pixels, shows at its corners."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    image = Image.fromarray(np.arange(12, dtype=np.uint8).reshape(2, 2, 3))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    return trimesh.Trimesh(
        size * np.column_stack([corners, np.zeros(4)]),
        [[0, 1, 2], [0, 2, 3]],
        visual=trimesh.visual.TextureVisuals(uv=corners, material=material),
        process=False,
    )


def ordered(points):
    return np.asarray(points[np.lexsort(np.round(points, 4).T)])


def test_a_glb_file_is_in_metres_and_another_unit_is_logged(write, caplog):
    path = write("box.glb", exported(BOX.copy().apply_scale(0.001), "glb"))
    with caplog.at_level(logging.INFO):
        np.testing.assert_allclose(np.ptp(read_mesh(path).vertices, axis=0), [0.01, 0.02, 0.03])
        assert load_part(path).diameter == pytest.approx(np.sqrt(1400) / 1000)
        assert caplog.messages == ["box: 30 × 20 × 10 mm, read in m"]
    assert np.ptp(read_mesh(path, "cm").vertices) == pytest.approx(0.0003)
    assert f"{path} is in m by its format, but read in cm as requested" in caplog.text
    with pytest.raises(UserError, match=r"37\.42 m, from a mesh with unit=m; .*unit=mm"):
        load_part(write("large.glb", GLB))


def test_the_nodes_of_a_glb_scene_are_merged_into_one_mesh(write, volume):
    scene = trimesh.Scene()
    scene.add_geometry(BOX, transform=TURN)
    scene.add_geometry(BOX, transform=np.diag([1, 1, -2, 1]))
    scene.add_geometry(trimesh.load_path(np.array([[[0, 0, 0], [99, 0, 0]]])))
    loaded = read_mesh(write("two.glb", exported(scene, "glb")), "mm")
    # The line is left out, and the mirrored box faces outwards.
    turned = trimesh.transform_points(BOX.vertices, TURN)
    expected = ordered(np.concatenate([turned, BOX.vertices * [1, 1, -2]]))
    np.testing.assert_allclose(ordered(1000 * loaded.vertices), expected, atol=1e-5)
    assert volume(loaded) == pytest.approx(3 * 6e-6, rel=1e-6)


def test_a_glb_file_has_one_hash(write):
    """trimesh gives the pieces of one mesh random names."""

    def edit(header):
        primitive = header["meshes"][0]["primitives"][0]
        header["meshes"][0]["primitives"] = [primitive, primitive | {"mode": 5}, primitive]

    path = write("a.glb", edited(GLB, edit))
    assert len({load_part(path, "mm").mesh_hash for _ in range(5)}) == 1


def test_glb_and_obj_textures_have_the_same_coordinates(tmp_path, write):
    square = textured_square()
    loaded = read_mesh(write("a.glb", exported(square, "glb")))
    np.testing.assert_array_equal(loaded.texture, square.visual.material.baseColorTexture)
    np.testing.assert_allclose(loaded.vertices[:, :2], 0.1 * loaded.uv, atol=1e-7)
    square.export(tmp_path / "a.obj")
    same = read_mesh(tmp_path / "a.obj", "m")
    np.testing.assert_array_equal(loaded.texture, same.texture)
    np.testing.assert_allclose(loaded.uv[loaded.faces], same.uv[same.faces], atol=1e-7)


def info(**fields):
    def edit(header):
        header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] |= fields

    return edit


def array(name, **fields):
    def edit(header):
        index = header["meshes"][0]["primitives"][0]["attributes"][name]
        header["accessors"][index] |= fields

    return edit


SPARSE = {"count": 1, "indices": {}, "values": {}}
MOVED = {"KHR_texture_transform": {"scale": [2, 2]}}

GLB_CASES = {
    "a moved texture": (info(extensions=MOVED), "a texture with a transform"),
    "other coordinates": (info(texCoord=1), "second texture coordinates"),
    "coordinates in bytes": (
        array("TEXCOORD_0", componentType=5121, normalized=True), "coordinates that are floats"
    ),
    "too few coordinates": (array("TEXCOORD_0", count=3), "3 texture coordinates of 4 vertices"),
    "sparse positions": (array("POSITION", sparse=SPARSE), "compressed, sparse or missing"),
    "a fan": (
        lambda header: header["meshes"][0]["primitives"][0].update(mode=6), "a fan of triangles"
    ),
    "a quantised mesh": (
        lambda header: header.update(extensionsRequired=["KHR_mesh_quantization"]),
        "the extension KHR_mesh_quantization",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("edit", "message"), GLB_CASES.values(), ids=GLB_CASES)
def test_glb_features_that_trimesh_ignores_are_refused(write, refused, edit, message):
    content = edited(exported(textured_square(), "glb"), edit)
    trimesh.load_scene(write("a.glb", content))  # without an error
    refused("a.glb", content, message)


def test_one_texture_must_cover_a_glb_file(refused):
    scene = trimesh.Scene([textured_square(), BOX])
    refused("a.glb", exported(scene, "glb"), r"faces of 2 textures; .* bake")


def test_a_glb_file_without_its_data_is_cut_short(refused):
    end = 20 + int.from_bytes(GLB[12:16], "little")
    nothing = GLB[:8] + struct.pack("<I", end) + GLB[12:end]
    refused("a.glb", nothing, r"a\.glb with error: unpack_from")
    short = GLB[:end] + struct.pack("<I", 4) + b"BIN\0" + bytes(4)
    refused("b.glb", short[:8] + struct.pack("<I", len(short)) + short[12:], r"b\.glb with")


@pytest.mark.parametrize("unit", UNITS_3MF)
def test_a_3mf_file_states_its_unit(write, unit, caplog, volume):
    metres = {"millimeter": 1e-3, "centimeter": 1e-2, "meter": 1, "inch": 0.0254}[unit]
    stated = repacked(BOX_3MF, lambda model: model.replace(b"millimeter", unit.encode()))
    path = write("box.3mf", stated)
    loaded = read_mesh(path)
    np.testing.assert_allclose(np.ptp(loaded.vertices, axis=0), metres * np.array([10, 20, 30]))
    assert volume(loaded) == pytest.approx(6000 * metres**3)
    assert not caplog.records
    if unit != "inch":
        read_mesh(path, "inch")
        assert f"is in {UNITS_3MF[unit]} by its format, but read in inch" in caplog.text


def test_a_3mf_file_without_a_unit_is_in_millimetres_and_feet_are_refused(write):
    bare = repacked(BOX_3MF, lambda model: model.replace(b'unit="millimeter"', b""))
    loaded = read_mesh(write("bare.3mf", bare))
    np.testing.assert_allclose(np.ptp(loaded.vertices, axis=0), [0.01, 0.02, 0.03])
    feet = repacked(BOX_3MF, lambda model: model.replace(b"millimeter", b"foot"))
    with pytest.raises(UserError, match=r"the unit 'foot'; allowed: millimeter, .*millimetres"):
        read_mesh(write("feet.3mf", feet))


def test_the_objects_of_a_3mf_build_are_merged_into_one_mesh(write, volume):
    def transform(x):
        return f'transform="1 0 0 0 0 1 0 -1 0 {x} 0 7"'

    def assemble(model):
        text = re.sub(r"<build.*</build>", "<build>@</build>", model.decode(), flags=re.DOTALL)
        number = re.findall(r'<object[^>]*\bid="(\d+)"', text)[0]
        arm = f'<component objectid="{number}"/><component objectid="{number}" {transform(40)}/>'
        whole = f'<object id="99"><components>{arm}</components></object></resources>'
        text = text.replace("</resources>", whole)
        items = f'<item objectid="99" {transform(100)}/><item objectid="{number}"/>'
        return text.replace("@", items).encode()

    loaded = read_mesh(write("three.3mf", repacked(BOX_3MF, assemble)))
    assert volume(loaded) == pytest.approx(3 * 6e-6)
    # A 3MF row is a column of ours: a quarter turn about x, then a shift.
    T = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 7], [0, 0, 0, 1.0]])
    first, second = T + 100 * np.eye(4, k=3), T + 40 * np.eye(4, k=3)
    matrices = (np.eye(4), first, first @ second)
    expected = np.concatenate([trimesh.transform_points(BOX.vertices, M) for M in matrices])
    np.testing.assert_allclose(ordered(1000 * loaded.vertices), ordered(expected), atol=1e-9)


def test_a_3mf_model_that_ends_too_early_is_refused(refused):
    size = len(repacked(BOX_3MF, lambda model: model))
    for length in range(500, size, 97):
        cut = repacked(BOX_3MF, lambda model, n=length: model[:n])
        refused("a.3mf", cut, r"a\.3mf with .*export the mesh again")
