"""Hostile and damaged images, meshes, archives, tables and records."""

import gzip
import io
import json
import re
import shlex
import struct
import tarfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from PIL import Image
from typer.testing import CliRunner

from dopepp.cli import app
from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_models import read_models
from dopepp.data.formats.bop.bop_results import read_results
from dopepp.data.formats.images import decode_depth, decode_mask, decode_rgb
from dopepp.data.formats.webdataset import index_shard
from dopepp.data.formats.ycb_video import read_meta
from dopepp.drawing.pictures import read_image, read_picture, read_rgb
from dopepp.parts import read_mesh
from dopepp.parts.mesh.read import ycb_part
from tests.security.conftest import bounded, refused

pytestmark = pytest.mark.timeout(60)


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width: int, height: int, *chunks: bytes, depth: int = 8, colour: int = 2) -> bytes:
    """Return a PNG file with any header."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    body = b"".join([chunk(b"IHDR", header), *chunks, chunk(b"IEND", b"")])
    return b"\x89PNG\r\n\x1a\n" + body


def encoded(kind: str, image: Image.Image, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def jpeg_of(width: int, height: int) -> bytes:
    """Return a small JPEG whose frame header states another size."""
    content = bytearray(encoded("JPEG", Image.new("RGB", (8, 8))))
    frame = content.index(b"\xff\xc0")
    content[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    return bytes(content)


def tiff(**fields: tuple[int, int, int]) -> bytes:
    """Return a TIFF file with any directory entries: (type, count, value) by tag."""
    entries = b"".join(
        struct.pack("<HHII", int(tag[1:]), *entry) for tag, entry in sorted(fields.items())
    )
    return b"II*\x00" + struct.pack("<IH", 8, len(fields)) + entries + bytes(4)


TIFF_SIZE = {"t256": (4, 1, 10**9), "t257": (4, 1, 10**9), "t258": (3, 1, 8), "t259": (3, 1, 1)}
SMALL = Image.new("RGB", (16, 16))

IMAGES: dict[str, Any] = {  # bytes, or what makes them, where that takes long
    "a PNG of terapixels": png(2**31 - 1, 2**31 - 1, chunk(b"IDAT", zlib.compress(bytes(9)))),
    "a PNG of gigapixels in one row": png(2**31 - 1, 1, chunk(b"IDAT", zlib.compress(bytes(9)))),
    "a PNG without pixels": png(0, 0, chunk(b"IDAT", b"")),
    "a PNG with fewer pixels than it says": png(64, 64, chunk(b"IDAT", zlib.compress(bytes(9)))),
    "a PNG of no depth": png(4, 4, chunk(b"IDAT", zlib.compress(bytes(52))), depth=7),
    "a PNG whose text explodes": lambda: png(
        4, 4, chunk(b"zTXt", b"a\x00\x00" + zlib.compress(bytes(200_000_000))),
        chunk(b"IDAT", zlib.compress(bytes(52))),
    ),
    "a PNG whose profile explodes": lambda: png(
        4, 4, chunk(b"iCCP", b"a\x00\x00" + zlib.compress(bytes(200_000_000))),
        chunk(b"IDAT", zlib.compress(bytes(10))),
    ),
    "a JPEG of gigapixels": jpeg_of(65535, 65535),
    "a JPEG without height": jpeg_of(8, 0),
    "a TIFF of exapixels": tiff(**TIFF_SIZE),
    "a TIFF whose strips lie": tiff(
        **{**TIFF_SIZE, "t256": (4, 1, 64), "t257": (4, 1, 64), "t273": (4, 1, 10**9),
           "t279": (4, 1, 10**9)}
    ),
    "a TIFF of a billion strips": tiff(
        **{**TIFF_SIZE, "t256": (4, 1, 64), "t257": (4, 1, 64), "t273": (4, 10**9, 8)}
    ),
    "a TIFF whose directory is itself": b"II*\x00" + struct.pack("<I", 4),
    "a BMP of gigapixels": b"BM" + struct.pack(
        "<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, 10**5, 10**5, 1, 24, 0, 0, 0, 0, 0, 0
    ),
    "a TGA of gigapixels": bytes([0, 0, 2]) + bytes(9) + b"\xff" * 4 + bytes([24, 0]),
    "a WebP that lies": b"RIFF" + struct.pack("<I", 2**31) + b"WEBPVP8X" + bytes(18),
    "PostScript, which runs": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n(x) run\n",
    "SVG, which links": b'<svg><image href="/etc/passwd"/></svg>',
    "an icon": encoded("ICO", SMALL),
    "a GIF": encoded("GIF", SMALL),
    "a PDF": encoded("PDF", SMALL),
    "a zip": b"PK\x05\x06" + bytes(18),
}  # fmt: skip


def made(content: Any) -> bytes:
    """Return the bytes of a file, calling the function that makes a large file."""
    return bytes(content() if callable(content) else content)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("name", IMAGES)
def test_hostile_images(name, suffix, tmp_path):
    path = tmp_path / f"image{suffix}"
    content = made(IMAGES[name])
    path.write_bytes(content)
    reads = (
        lambda: read_rgb(path),
        lambda: decode_rgb(content, "image"),
        lambda: decode_depth(content, "image", 1.0, (4, 4)),
        lambda: decode_mask(content, "image", (4, 4)),
    )
    for read in reads:
        with refused("image"):
            read()
    with bounded(), pytest.raises(ValueError, match=r".") as caught:
        read_picture(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["PNG", "WEBP", "TIFF"])
def test_the_first_image_of_an_animation_is_read(kind, tmp_path):
    frames = [Image.new("RGB", (16, 12), (level, 0, 0)) for level in (200, 100, 50)]
    options = {"lossless": True} if kind == "WEBP" else {}
    content = encoded(kind, frames[0], save_all=True, append_images=frames[1:], **options)
    path = tmp_path / "a.img"
    path.write_bytes(content)
    assert (read_picture(path) == (200, 0, 0)).all()
    assert read_picture(path).shape == (12, 16, 3)


def test_image_paths_without_a_file(tmp_path):
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "loop.png").symlink_to(tmp_path / "loop.png")
    for name in ("folder.png", "loop.png", "x" * 300 + ".png", "none.png"):
        with refused("image .*png"):
            read_image(tmp_path / name)


PLY = "ply\nformat {form} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\n"
PLY += "property float z\nelement face {faces}\nproperty list {count} int vertex_indices\n"
PLY += "{more}end_header\n"


def ply(form: str = "ascii", vertices: object = 3, faces: object = 1, count: str = "uchar",
        more: str = "", body: bytes = b"0 0 0\n9 0 0\n0 9 0\n3 0 1 2\n") -> bytes:  # fmt: skip
    text = PLY.format(form=form, vertices=vertices, faces=faces, count=count, more=more)
    return text.encode() + body


VERTICES = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0]], "<f4").tobytes()
TRIANGLE = "v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n"

MESHES = {
    "a.ply|a billion vertices": ply(vertices=10**9),
    "b.ply|a billion vertices in binary": ply("binary_little_endian", 10**9, body=VERTICES),
    "c.ply|vertices beyond any number": ply(vertices="9" * 5000),
    "d.ply|a negative count": ply(vertices=-3),
    "e.ply|a list of four billion": ply(
        "binary_little_endian", count="uint", body=VERTICES + b"\xff" * 4 + bytes(12)
    ),
    "f.ply|a billion elements of nothing": ply(more=f"element x {10**12}\n"),
    "g.ply|a million elements": ply(more="element x 0\nproperty int y\n" * 20_000),
    "p.ply|a million properties": ply(more="property int y\n" * 20_000),
    "h.ply|a texture elsewhere": ply(more="comment TextureFile /etc/passwd\n"),
    "i.ply|a texture in another folder": ply(more="comment TextureFile ../../secret.png\n"),
    "j.ply|endless header": b"ply\nformat ascii 1.0\n" + b"comment x\n" * 20_000,
    "k.stl|a header that promises gigabytes": bytes(80) + struct.pack("<I", 2**32 - 1),
    "l.stl|text without an end": b"solid x\n" + b"facet normal 0 0 1\n" * 50_000,
    "m.stl|a number of a million digits": b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 "
    + b"9" * 1_000_000,
    "n.obj|a library elsewhere": b"mtllib /etc/passwd\n" + TRIANGLE.encode(),
    "o.obj|a library in another folder": b"mtllib ../../../etc/passwd\n" + TRIANGLE.encode(),
    "p.obj|a library of another machine": b"mtllib \\\\server\\share\\x.mtl\n" + TRIANGLE.encode(),
    "q.obj|a library of the web": b"mtllib http://localhost/x.mtl\n" + TRIANGLE.encode(),
    "r.obj|a device": b"mtllib /dev/zero\n" + TRIANGLE.encode(),
    "s.obj|an index of a million digits": b"v 0 0 0\nf 1 1 " + b"9" * 1_000_000,
    "t.obj|a face of a corner a million times": b"v 0 0 0\nf" + b" 1" * 50_000,
    "u.obj|continued for ever": b"\\\n" * 500_000,
    "v.gltf|links": b'{"buffers": [{"uri": "file:///etc/passwd"}]}',
    "w.glb|links": b"glTF\x02\x00\x00\x00",
    "x.3mf|an archive": b"PK\x03\x04",
    "y.dae|entities": b'<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><COLLADA>&a;</COLLADA>',
    "z.pkl|a pickle": b"cposix\nsystem\n(S'true'\ntR.",
}


@pytest.mark.parametrize("name", MESHES)
def test_hostile_meshes(name, tmp_path):
    path = tmp_path / "deep" / name.split("|")[0]
    path.parent.mkdir()
    path.write_bytes(MESHES[name])
    with refused(path.name):
        read_mesh(path, "mm")


def test_a_material_with_a_texture_outside_its_folder(tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    folder = tmp_path / "part"
    folder.mkdir()
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    textured = "mtllib a.mtl\nv 0 0 0\nv 9 0 0\nv 0 9 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n"
    (folder / "a.obj").write_text(textured)
    for name in (str(tmp_path / "secret.png"), "../secret.png", "link.png", "..\\secret.png"):
        (folder / "a.mtl").write_text(f"newmtl m\nmap_Kd {name}\n")
        with refused("outside of its folder"):
            read_mesh(folder / "a.obj", "mm")


def test_points_of_gigabytes(tmp_path):
    model = tmp_path / "models" / "box"
    model.mkdir(parents=True)
    with (model / "points.xyz").open("wb") as file:
        file.truncate(10**11)
    with refused(r"points\.xyz"):
        ycb_part(tmp_path, "box")


def entry(
    name: str, kind: bytes = tarfile.REGTYPE, size: int = 0, link: str = ""
) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.size, info.linkname, info.mode = kind, size, link, 0o4777
    return info


def tar(*entries: tarfile.TarInfo, content: bytes = b"") -> bytes:
    return b"".join(entry.tobuf(tarfile.GNU_FORMAT) for entry in entries) + content + bytes(10_240)


def pax(records: dict[str, str]) -> bytes:
    """Return a member whose extended header contradicts its plain header."""
    lines = b""
    for key, value in records.items():
        body = f" {key}={value}\n".encode()
        length = len(body) + len(str(len(body) + 3))
        lines += f"{length}".encode() + body
    data = lines + bytes(-len(lines) % 512)
    head = entry("x", tarfile.XHDTYPE, len(lines)).tobuf()
    return head + data + entry("a.txt").tobuf() + bytes(10_240)


ARCHIVES: dict[str, Any] = {
    "a link out": tar(entry("a", tarfile.SYMTYPE, link="/etc")),
    "a link and a file through it": tar(
        entry("a", tarfile.SYMTYPE, link="/tmp"), entry("a/canary")
    ),
    "a hard link": tar(entry("a", tarfile.LNKTYPE, link="/etc/passwd")),
    "a device": tar(entry("a", tarfile.CHRTYPE)),
    "a pipe": tar(entry("a", tarfile.FIFOTYPE)),
    "a disk": tar(entry("a", tarfile.BLKTYPE)),
    "holes of terabytes": tar(entry("a", tarfile.GNUTYPE_SPARSE, 2**40)),
    "a size of exabytes": tar(entry("a", size=2**60)),
    "a size beyond the end": tar(entry("a", size=10**6)),
    "a name of gigabytes": tar(entry("././@LongLink", tarfile.GNUTYPE_LONGNAME, 2**32)),
    "a link's name of gigabytes": tar(entry("././@LongLink", tarfile.GNUTYPE_LONGLINK, 2**32)),
    "an extended header of gigabytes": tar(entry("x", tarfile.XHDTYPE, 2**32)),
    "a path out in the extended header": pax({"path": "../../canary"}),
    "a negative size in the extended header": pax({"size": "-1"}),
    "holes in the extended header": pax(
        {"GNU.sparse.map": "0,1099511627776", "GNU.sparse.size": "1099511627776"}
    ),
    "a name twice": tar(entry("a"), entry("a")),
    "a name twice where letters have no case": tar(entry("Photo"), entry("PHOTO")),
    "a gzip bomb": lambda: gzip.compress(tar(entry("a", size=10**8), content=bytes(10**8))),
    "a name with a screen's commands": tar(entry("\x1b[2Jcanary")),
}


@pytest.mark.parametrize("name", ARCHIVES)
def test_hostile_shards(name, tmp_path):
    """A shard is never unpacked; its hostile members are rejected or skipped."""
    path = tmp_path / "shard-000000.tar"
    path.write_bytes(made(ARCHIVES[name]))
    line = ""
    with bounded():
        try:
            assert not index_shard(path).keys
        except UserError as error:
            line = str(error)
    assert "\n" not in line


def mat(**fields: object) -> bytes:
    file = io.BytesIO()
    scipy.io.savemat(file, fields, do_compression=True)
    return file.getvalue()


GOOD_META = {"cls_indexes": [[2.0]], "poses": np.eye(3, 4)[..., None], "factor_depth": 10000}
METAS = {
    "a matrix that explodes": mat(**{**GOOD_META, "poses": np.zeros((3, 4, 300_000))}),
    "objects": mat(**{**GOOD_META, "poses": np.array([{"a": 1}], object)}),
    "text": mat(**{**GOOD_META, "factor_depth": "os.system"}),
    "complex numbers": mat(**{**GOOD_META, "poses": 1j * np.eye(3, 4)[..., None]}),
    "classes that are none": mat(**{**GOOD_META, "cls_indexes": [[np.nan]]}),
    "a class of all": mat(**{**GOOD_META, "cls_indexes": [[1e300]]}),
    "no version of this format": b"MATLAB 7.3 MAT-file".ljust(126) + b"\x02IM",
}


HEADER = "scene_id,im_id,obj_id,score,R,t,time\n"
POSE = "1 0 0 0 1 0 0 0 1,0 0 900,1"
TABLES = {
    "a formula of a spreadsheet": f"{HEADER}=cmd|'/c calc'!A1,1,1,1,{POSE}".encode(),
    "an image of a million digits": f"{HEADER}{'9' * 5000},1,2,1,{POSE}".encode(),
    "a line of megabytes": (HEADER + "1" * 5_000_000).encode(),
    "a rotation of a million numbers": f"{HEADER}1,1,2,1,{'1 ' * 1_000_000},0 0 9,1".encode(),
    "quotes without an end": f'{HEADER}"1,1,2,1,{POSE}'.encode(),
    "zero bytes": HEADER.encode() + bytes(1000),
}


RECORDS = {
    "a number beyond all": b'{"1": {"diameter": 1e999}}',
    "a model of a million digits": b'{"' + b"9" * 5000 + b'": {"diameter": 1}}',
    "a model of other digits": '{"\u0661": {"diameter": 1}}'.encode(),
    "a path for a number": b'{"../../etc/passwd": {"diameter": 1}}',
    "symmetries without an end": json.dumps(
        {"1": {"diameter": 9.0, "symmetries_discrete": [[1.0] * 16] * 2_000}}
    ).encode(),
}


READERS = {
    "meta.mat": (read_meta, METAS),
    "method_set-test.csv": (lambda path: read_results(path, {2}), TABLES),
    "models/models_info.json": (lambda path: read_models(path.parents[1]), RECORDS),
}


@pytest.mark.parametrize(
    ("file", "name"), [(file, name) for file, (_, table) in READERS.items() for name in table]
)
def test_hostile_tables_and_records(file, name, tmp_path):
    read, table = READERS[file]
    path = tmp_path / file
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(table[name])
    with refused(re.escape(path.name)):
        read(path)


RENDER = "render servoholder --out out -n 1"
BOMB = IMAGES["a PNG of terapixels"]
ARGUMENTS = {
    "check: a folder of records that nest": ("check set", {
        "set/_camera_settings.json": b"[" * 100_000,
        "set/000000.json": b"[" * 100_000,
        "set/000000.png": BOMB,
    }),
    "render: a change that nests": (f"{RENDER} --set targets_per_image={'[' * 5000}", {}),
    "render: a change that runs": (
        f"{RENDER} --set 'targets_per_image=!!python/object/apply:os.system [touch canary]'", {}
    ),

    "predict: a depth that explodes": (
        "predict good.ckpt b.png --K 60 60 8 8 --refine depth --depth a.png",
        {"a.png": BOMB, "b.png": encoded("PNG", SMALL)},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ARGUMENTS)
def test_hostile_input_ends_a_command_with_one_line(name, good, tmp_path, monkeypatch):
    arguments, files = ARGUMENTS[name]
    monkeypatch.chdir(good.parent)
    for file, content in files.items():
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        Path(file).write_bytes(content)
    with bounded():
        done = CliRunner().invoke(app, shlex.split(arguments))
    assert done.exit_code in ((1, 2) if name.startswith("check") else (2,)), done.output[-2000:]
    assert "Traceback" not in done.output
    assert isinstance(done.exception, SystemExit)
    assert not Path("canary").exists()
