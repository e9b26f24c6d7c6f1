"""STL, 3MF and GLB files: checked to be whole and harmless, then read by trimesh.

trimesh takes a file that ends too early for a smaller mesh, passes over what it does not know, and
spends what memory and time a file asks for (``tests/parts/mesh/test_library.py``,
``tests/security/test_hostile_scenes.py``). So of GLB, glTF in one file, compressed, quantised and
sparse data, triangle fans and moved textures are refused. All but shape and texture is left out.

To add a format that trimesh reads, check its file first and hand it to :func:`read_scene`.
"""

from __future__ import annotations

import io
import json
import re
import struct
import warnings
import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import whole_picture
from dopepp.geometry.camera import Transform
from dopepp.parts.mesh import RawMesh, Vertices, weld

MAX_UNPACKED_BYTES: Final = 50_000_000
"""Of the text in a 3MF file: trimesh takes 17 times as much memory."""

MAX_PIECES: Final = 1000
"""Meshes that make up one part: far above any part's bodies, and a bound on time."""

MAX_TRIANGLES: Final = 5_000_000  # Of all pieces, each counted as often as it is shown
UNITS_3MF: Final = {"millimeter": "mm", "centimeter": "cm", "meter": "m", "inch": "inch"}
"""Ours by 3MF's name, which also has feet and micrometres."""

_STL_HEADER: Final = 84
_STL_TRIANGLE: Final = 50
"""Bytes. A binary STL file is a title, the number of triangles (uint32), and the triangles."""

MAX_HEADER_BYTES: Final = 10_000_000  # Of the JSON: Python takes twenty times as much memory
MAX_VALUES: Final = 30_000_000
"""Numbers and vectors that primitives use: each gets a copy, of an array that others use too."""

_FLOAT: Final = 5126  # glTF's number of the type
_TRIANGLES: Final = 4  # glTF's number of the mode; lower ones are points and lines


def read_stl(path: Path) -> RawMesh:
    """Read a binary or text STL file, with the corners that its triangles share merged.

    Raises:
        ValueError: It is not as long as the number of its triangles says, or not finite.
    """
    data = path.read_bytes()
    num_triangles = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    promised = _STL_HEADER + _STL_TRIANGLE * num_triangles
    # Binary headers may begin with the text format's "solid"; the length cannot be mistaken.
    is_text = len(data) != promised or not num_triangles
    if is_text and b"\0" in data:  # never in text
        said = f"{num_triangles} triangles, {promised} bytes"
        raise ValueError(f"{len(data)} bytes where its header promises {said}")
    (vertices, faces, *_), _ = read_scene(data, "stl")
    # trimesh leaves out a text file's last solid if it is cut short.
    facets = re.finditer(rb"\bfacet\s+normal\b", data, re.IGNORECASE)
    begun = sum(1 for _ in facets) if is_text else len(faces)
    if begun != len(faces):
        raise ValueError(f"{begun} facets begun and {len(faces)} ended")
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():  # named here, where triangles have their numbers
        triangle, vertex = divmod(int(np.flatnonzero(~finite[faces.reshape(-1)])[0]), 3)
        location = f"triangle {triangle + 1}, vertex {vertex + 1}"
        raise ValueError(f"a coordinate that is not a finite number, {location}")
    return RawMesh(*weld(vertices, faces))


def read_3mf(path: Path) -> RawMesh:
    """Read what a 3MF file's build shows, in the unit that it states.

    Raises:
        UserError: The unit is none of :data:`UNITS_3MF`.
        ValueError: The file is no whole archive, unpacks to too much, declares a document type,
            shows objects of other files, or ones that are not above their users.
    """
    size = path.stat().st_size
    _check_size(size)
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(info.file_size for info in archive.infolist())
        # Models unpack to 5 to 15 times their size.
        _check_size(unpacked, max(MAX_UNPACKED_BYTES // 10, 30 * size))
        names = [name for name in archive.namelist() if "3d/3dmodel.model" in name.lower()]
        if len(names) != 1:
            raise ValueError(f"{len(names)} 3D/3dmodel.model where one must be")
        model = archive.read(names[0])
    if b"<!DOCTYPE" in model.replace(b"\0", b""):  # also in UTF-16
        raise ValueError("a document type, which 3MF forbids")
    num_pieces = _count_pieces(model)
    mesh, num_read = read_scene(path.read_bytes(), "3mf")
    if num_read != num_pieces:  # trimesh gives up on crowded assemblies
        raise ValueError(f"{num_pieces} objects shown, {num_read} read")
    unit = str(mesh.unit).removesuffix("s")  # it calls the default one "millimeters"
    if unit not in UNITS_3MF:
        problem, allowed = f"mesh {path} in the unit {unit!r}", ", ".join(UNITS_3MF)
        raise UserError(problem, allowed, "export it in millimetres")
    return mesh._replace(unit=UNITS_3MF[unit])


def _count_pieces(model: bytes) -> int:
    """Count the meshes that a 3MF build shows."""
    # trimesh follows objects that contain themselves, and one that is doubled twenty times over,
    # for hours. Of objects in another file it takes all where one is meant.
    from lxml import etree

    pieces: dict[str, int] = {}
    shown = 0
    tags = ("{*}object", "{*}item")
    for _, element in etree.iterparse(io.BytesIO(model), tag=tags, resolve_entities=False):
        users = [element] if element.tag.endswith("item") else element.findall(".//{*}component")
        if any(name.endswith("path") for user in users for name in user.attrib):
            raise ValueError("objects in other files of the archive")
        unknown = [user.get("objectid") for user in users if user.get("objectid") not in pieces]
        if unknown:
            raise ValueError(f"object {unknown[0]!r} used above its end, or nowhere defined")
        count = sum(pieces[user.get("objectid")] for user in users)
        if element.tag.endswith("item"):
            shown += count
        else:
            pieces[element.attrib["id"]] = count or 1
        if max(len(pieces), shown, count) > MAX_PIECES:
            raise ValueError(f"over {MAX_PIECES} objects")
    return shown


def _check_size(num_bytes: int, most: int = MAX_UNPACKED_BYTES) -> None:
    if num_bytes > min(most, MAX_UNPACKED_BYTES):
        raise ValueError(f"{num_bytes / 1e6:.0f} MB of text, over {most / 1e6:.0f} MB")


def read_glb(path: Path) -> RawMesh:
    """Read what a GLB file's scene shows, in metres, with its one texture.

    Raises:
        UserError: It needs other files, or its faces have several textures.
        ValueError: It is cut short, damaged or too large, or has what is not read.
    """
    header, binary = _chunks(path.read_bytes())
    files = [entry for kind in ("buffers", "images") for entry in header.get(kind, ())]
    if outside := [entry["uri"] for entry in files if "uri" in entry]:
        problem = f"mesh {path} that needs the file {str(outside[0])[:60]!r}"
        allowed = "a GLB file with its arrays and textures inside"
        raise UserError(problem, allowed, "export the mesh again as one binary file")
    primitives = [p for mesh in header.get("meshes", ()) for p in mesh["primitives"]]
    _check(header, primitives, len(binary))
    drawn = [p for p in primitives if p.get("mode", _TRIANGLES) >= _TRIANGLES]
    pictures = {_picture(header, primitive) for primitive in drawn}
    if len(pictures) > 1:
        problem = f"mesh {path} with faces of {len(pictures)} textures"
        fix = "bake them into one texture, or remove them"
        raise UserError(problem, "one texture for all faces, or none", fix)
    picture = next(iter(pictures), None)
    texture = None
    if picture is not None:
        view = header["bufferViews"][header["images"][picture]["bufferView"]]
        start = view.get("byteOffset", 0)
        try:
            image = whole_picture(binary[start : start + view["byteLength"]])
        except ValueError as error:
            raise ValueError(f"a texture that cannot be read: {error}") from error
        texture = np.asarray(image.convert("RGB"))
    # trimesh would open pictures of any kind; for texture coordinates it needs but a material.
    header |= {"images": [], "materials": [{} for _ in header.get("materials", ())]}
    mesh, _ = read_scene(_packed(header, binary), "glb")
    return mesh._replace(uv=None if texture is None else mesh.uv, texture=texture, unit="m")


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk, without which trimesh takes a file as well."""
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    if (magic, version, kind, length) != (b"glTF", 2, b"JSON", len(data)):
        raise ValueError(f"{len(data)} bytes, not the {length} of a GLB file of version 2")
    if size > MAX_HEADER_BYTES:
        raise ValueError(f"{size} bytes of JSON, over {MAX_HEADER_BYTES}")
    start = 20 + size + 8
    size, kind = struct.unpack_from("<I4s", data, start - 8)
    if kind != b"BIN\0" or start + size > len(data):
        raise ValueError(f"no binary chunk, or one of less than its {size} bytes")
    return json.loads(data[20 : start - 8]), data[start : start + size]


def _packed(header: dict[str, Any], binary: bytes) -> bytes:
    """Make a GLB file."""
    text = json.dumps(header).encode()
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _check(header: dict[str, Any], primitives: list[dict[str, Any]], num_bytes: int) -> None:
    """Refuse what trimesh leaves out, and what takes it far more memory or time than the file."""
    required = [name for name in header.get("extensionsRequired", ()) if "_materials_" not in name]
    if required:
        raise ValueError(f"the extension {required[0]}, which is not read")
    if any(primitive.get("mode") == 6 for primitive in primitives):
        raise ValueError("a fan of triangles, which is not read")
    accessors = header.get("accessors", ())
    if any("bufferView" not in array or "sparse" in array for array in accessors):
        raise ValueError("an array that is compressed, sparse or left out")
    sizes = [view["byteLength"] for view in header.get("bufferViews", ())]
    counts = [array["count"] for array in accessors]
    used = [i for p in primitives for i in (*p["attributes"].values(), p.get("indices"))]
    num_values = sum(counts[i] for i in used if i is not None)
    # An item is a byte at least; views of the same bytes, and arrays of the same items, are rare.
    too_many = max(sum(sizes) // 2, sum(counts)) > num_bytes or num_values > MAX_VALUES
    if min(sizes + counts, default=0) < 0 or too_many:
        raise ValueError(f"arrays of more than its {num_bytes} bytes, or over {MAX_VALUES} values")
    nodes = header.get("nodes", ())
    if max(len(nodes), len(primitives)) > MAX_PIECES:
        raise ValueError(f"{len(nodes)} nodes and {len(primitives)} primitives, over {MAX_PIECES}")
    children = [child for node in nodes for child in node.get("children", ())]
    for scene in header.get("scenes", ())[header.get("scene", 0) :][:1]:
        children += scene.get("nodes", ())
    if len(set(children)) < len(children):
        raise ValueError("a node in two places")


def _picture(header: dict[str, Any], primitive: dict[str, Any]) -> int | None:
    """Return which picture gives a primitive its colours, None for one without."""
    material = header["materials"][primitive["material"]] if "material" in primitive else {}
    info = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    if info is None:
        return None
    array = primitive["attributes"].get("TEXCOORD_0")
    if array is None or header["accessors"][array]["componentType"] != _FLOAT:
        raise ValueError("a texture, and faces without texture coordinates that are floats")
    if info.get("texCoord") or "KHR_texture_transform" in info.get("extensions", {}):
        raise ValueError("a texture with a transform, or with the second texture coordinates")
    return int(header["textures"][info["index"]]["source"])


def read_scene(data: bytes, kind: str) -> tuple[RawMesh, int]:
    """Let trimesh read a file's content; without a path it can reach no other file.

    Returns:
        The meshes as one, with the unit as trimesh names it, and their number.

    Raises:
        ValueError: A face has a vertex that its mesh has not, or there are too many triangles.
        Exception: Whatever trimesh makes of a damaged file.
    """
    import trimesh  # takes a while: only for those who read such a file

    # An infinite corner is named later, not in trimesh's own sums.
    with warnings.catch_warnings(), np.errstate(invalid="ignore", over="ignore"):
        # numpy stops at a damaged number with nothing but this warning.
        warnings.simplefilter("error", DeprecationWarning)
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
    vertices, faces = [np.empty((0, 3))], [np.empty((0, 3), np.int64)]
    uvs: list[Any] = []
    start = num_triangles = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not hasattr(mesh, "faces"):
            continue  # lines and points
        if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError(f"a face index outside of its {len(mesh.vertices)} vertices")
        num_triangles += len(mesh.faces)
        if num_triangles > MAX_TRIANGLES:
            raise ValueError(f"over {MAX_TRIANGLES} triangles")
        vertices.append(_moved(np.asarray(mesh.vertices), transform))
        faces.append(np.asarray(mesh.faces) + start)
        uvs.append(getattr(mesh.visual, "uv", None))
        start += len(mesh.vertices)
    uv = None if not uvs or any(uv is None for uv in uvs) else np.concatenate(uvs)
    if uv is not None and uv.shape != (start, 2):
        raise ValueError(f"{len(uv)} texture coordinates of {start} vertices")
    unit = scene.metadata.get("units")
    return RawMesh(np.concatenate(vertices), np.concatenate(faces), uv, unit=unit), len(uvs)


def _moved(vertices: Vertices, transform: Transform) -> Vertices:
    if (transform == np.eye(4)).all():
        return vertices  # as they are: a product would make NaN of an infinite one's neighbours
    # Not a product of matrices, whose last digits depend on the processor.
    rows = zip(vertices.T, transform[:3, :3].T, strict=True)
    return np.asarray(sum(x[:, None] * row for x, row in rows) + transform[:3, 3])
