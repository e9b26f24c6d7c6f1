"""Every reader on damaged files returns a result or raises one line for the user.

The same checks run twice: on few files with every test run, and, marked ``slow``, on as many as
take about ten minutes together with ``test_fuzz_decoder.py``. What such runs find is kept as a case
of its own, by the attack it would make.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import pytest
import scipy.io
import torch
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from trimesh.exchange.obj import export_obj
from trimesh.exchange.off import export_off
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl, export_stl_ascii

from dopepp.core.errors import UserError
from dopepp.core.yaml import read_yaml
from dopepp.data.check import check_dataset
from dopepp.data.formats.bop.bop_models import bop_parts
from dopepp.data.formats.bop.bop_results import read_results
from dopepp.data.formats.images import decode_depth, decode_mask, decode_rgb
from dopepp.data.formats.ycb_video import read_meta
from dopepp.data.sample import Instance, Sample
from dopepp.drawing.pictures import read_image, read_picture, read_rgb
from dopepp.geometry.camera import camera_matrix, project_keypoints
from dopepp.models.checkpoint import load_network
from dopepp.models.storage import read_safetensors, write_safetensors
from dopepp.parts.mesh.read import read_mesh
from dopepp.parts.part import make_part
from tests.data.makers import LAYOUTS, pose_at, write_set
from tests.parts.makers import mesh_of

QUICK: Final = 6
THOROUGH: Final = 300
"""Numbers of files of each kind, for seconds and for about ten minutes."""

MOST_CHARACTERS: Final = 3000
"""Largest length of the line for the user."""

TOKENS: Final = (
    b"nan", b"inf", b"-1", b"1e999", b"9" * 30, b"0", b"", b"null", b"[]", b"{}", b'"', b"\\",
    b"\n", b"\x00", b"\xff\xff\xff\xff", b"\x00\x00\x00\x80", b"true", b"1.5", b"/etc/passwd",
    b"../", b"[[",
)  # fmt: skip


NAMES: Final = (
    "a.ckpt", "a.safetensors", "a.yaml",
    "binary.ply", "binary.stl", "bop/camera.json", "bop/models/models_info.json",
    "bop/train_pbr/000000/scene_camera.json", "bop/train_pbr/000000/scene_gt.json",
    "bop/train_pbr/000000/scene_gt_info.json", "box.3mf", "box.glb", "box.obj", "box.off",
    "colour.bmp", "colour.jpg", "colour.png", "colour.tga", "colour.tiff", "colour.webp",
    "deep.png", "m_s-test.csv",
    "meta.mat", "ndds/000000.json", "ndds/_camera_settings.json", "ndds/_object_settings.json",
    "overrides.yaml", "palette.png", "print.jpg", "shards/models/models_info.json",
    "shards/train_pbr/key_to_shard.json", "shards/train_pbr/shard-000000.tar", "text.ply",
    "text.stl",
)  # fmt: skip
"""The damaged file: a single file, or a file of a data set."""


@st.composite
def damage(draw: st.DrawFn) -> list[tuple[str, float, bytes | float]]:
    """A damage of a file, at positions that are shares of its length."""
    share = st.floats(0, 1, exclude_max=True)
    step = st.one_of(
        st.tuples(st.just("put"), share, st.binary(min_size=1, max_size=4)),
        st.tuples(st.just("insert"), share, st.sampled_from(TOKENS)),
        st.tuples(st.just("word"), share, st.sampled_from(TOKENS)),
        st.tuples(st.just("cut"), share, st.floats(0, 0.1)),
        st.tuples(st.just("repeat"), share, st.floats(0, 0.1)),
        st.tuples(st.just("end"), share, st.just(0.0)),
    )
    return draw(st.lists(step, min_size=1, max_size=4))


def damaged(content: bytes, steps: list[tuple[str, float, Any]]) -> bytes:
    """Return the damaged content of a file."""
    for kind, share, what in steps:
        start = int(share * len(content))
        if kind == "put":
            content = content[:start] + what + content[start + len(what) :]
        elif kind == "insert":
            content = content[:start] + what + content[start:]
        elif kind == "word":  # a whole number, name or value of a text
            stop = start
            while stop < len(content) and content[stop : stop + 1] not in b' ,:\n"[]{}':
                stop += 1
            while start > 0 and content[start - 1 : start] not in b' ,:\n"[]{}':
                start -= 1
            content = content[:start] + what + content[stop:]
        elif kind == "end":
            content = content[:start]
        else:
            piece = content[start : start + int(what * len(content)) + 1]
            rest = content[start + len(piece) :] if kind == "cut" else content[start:]
            content = content[:start] + (b"" if kind == "cut" else piece) + rest
    return content


@dataclass(frozen=True)
class Target:
    """A reader and the correct file that is damaged.

    Attributes:
        folder: A correct data set, or a folder with a single file.
        file: The damaged file's path in the folder.
        reads: Functions that read the file, given the folder.
    """

    folder: Path
    file: str
    reads: tuple[Callable[[Path], object], ...]


def read_all(source: Any) -> None:
    """Call all methods of a data source."""
    for index in range(len(source)):
        sample = source.sample(index)
        assert np.isfinite(sample.K).all()
        assert all(np.isfinite(detection.T_cam_obj).all() for detection in sample.instances)
    source.contains("obj_000001")
    source.describe()


def read_finite_mesh(path: Path) -> None:
    mesh = read_mesh(path, "mm")
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)


def images(path: Path) -> tuple[Callable[[Path], object], ...]:
    """The readers of an image."""

    def read_any_format(folder: Path) -> object:
        try:
            return read_picture(folder / path.name)
        except ValueError as error:  # which its callers turn into one line
            raise UserError(str(error), "", "") from error

    def decoder(decode: Callable[..., object], *arguments: object) -> Callable[[Path], object]:
        return lambda folder: decode((folder / path.name).read_bytes(), path.name, *arguments)

    return (
        read_any_format,
        lambda folder: read_image(folder / path.name),
        lambda folder: read_rgb(folder / path.name),
        decoder(decode_rgb),
        decoder(decode_depth, 1.0, (24, 32)),
        decoder(decode_mask, (24, 32)),
    )


@pytest.fixture(scope="session")
def targets(tmp_path_factory, content):
    """Correct files of every kind."""
    root = tmp_path_factory.mktemp("good")
    return {**_files(root, content), **_datasets(root)}


def _files(root: Path, content: dict[str, Any]) -> dict[str, Target]:
    box = trimesh.creation.box((10.0, 20.0, 30.0))
    pixels = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (24, 32, 3), np.uint8),
                               (5, 5), 2)  # fmt: skip
    tensors = {"a": torch.arange(6.0).view(2, 3), "b": torch.zeros(0, dtype=torch.int8)}
    rows = "scene_id,im_id,obj_id,score,R,t,time\n" + "1,4,2,0.75,1 0 0 0 0 -1 0 1 0,-10 20 812,1\n"
    meta = {
        "cls_indexes": np.array([[2.0]]), "poses": pose_at(0, 0, 0.4)[:3, :, None],
        "intrinsic_matrix": np.eye(3), "factor_depth": 10000,
    }  # fmt: skip
    text = {
        "a.yaml": "a: {b: [1, 2.5, null]}\nc: 'x'\n",
        "overrides.yaml": "- model=dopepp\n- 'data.parts=[a]'\n",
    }
    meshes = {
        "binary.stl": export_stl(box),
        "text.stl": export_stl_ascii(box).encode(),
        "box.obj": b"mtllib box.mtl\n" + export_obj(box).encode(),
        "box.off": export_off(box).encode(),
        "box.glb": box.export(file_type="glb"),
        "box.3mf": box.export(file_type="3mf"),
        "binary.ply": export_ply(box),
        "text.ply": export_ply(box, encoding="ascii"),
    }
    colour = Image.fromarray(pixels)
    photos = {
        **{f"colour.{suffix}": colour for suffix in ("png", "jpg", "tiff", "webp", "bmp", "tga")},
        "palette.png": colour.convert("P"),
        "deep.png": Image.fromarray(pixels[..., 0].astype(np.uint16) * 200),
        "print.jpg": colour.convert("CMYK"),
    }
    files: dict[str, tuple[Callable[[Path], object], Callable[[Path], object] | None]] = {
        **{name: (partial(_put, data), read_finite_mesh) for name, data in meshes.items()},
        **{name: (image.save, None) for name, image in photos.items()},
        **{name: (partial(_put, data.encode()), read_yaml) for name, data in text.items()},
        "a.ckpt": (lambda path: torch.save(content, path), load_network),
        "a.safetensors": (
            lambda path: write_safetensors(path, tensors, {"spec": "{}"}), read_safetensors
        ),
        "m_s-test.csv": (partial(_put, rows.encode()), lambda path: read_results(path, {2})),
        "meta.mat": (lambda path: scipy.io.savemat(path, meta, do_compression=True), read_meta),
    }  # fmt: skip
    made = {}
    for name, (write, read) in files.items():
        folder = root / name
        folder.mkdir()
        (folder / "box.mtl").write_text("newmtl m\n")
        write(folder / name)
        alone = (lambda folder, name=name, read=read: read(folder / name),)
        made[name] = Target(folder, name, images(folder / name) if read is None else alone)
    return made


def _put(content: bytes, path: Path) -> None:
    path.write_bytes(content)


def _datasets(root: Path) -> dict[str, Target]:
    """Write two images in each layout with a writer."""
    part = make_part("obj_000001", mesh_of(trimesh.creation.box((0.04, 0.03, 0.02))))
    T, K = pose_at(0, 0, 0.3), camera_matrix(40.0, 40.0, 15.5, 11.5)
    mask = np.zeros((24, 32), bool)
    mask[10:14, 13:19] = True
    instance = Instance(part.name, T, project_keypoints(part.cuboid, T, K), 0.9, mask)
    depth = np.full((24, 32), 0.3, np.float32)
    sample = Sample(np.full((24, 32, 3), 90, np.uint8), K, [instance], depth)
    made = {}
    for name, layout in (("bop", "BOP"), ("shards", "BOP-WebDataset"), ("ndds", "NDDS")):
        writer, reader = LAYOUTS[layout]
        folder = write_set(writer, root / name, [part], [sample] * 2)

        def read(folder: Path, name: str = name, reader: Any = reader) -> None:
            read_all(reader(folder, [part] if name == "ndds" else bop_parts(folder)))

        for file in sorted(folder.rglob("*")):
            if file.suffix in (".json", ".tar") and "000001.json" not in file.name:
                relative = str(file.relative_to(folder))
                made[f"{name}/{relative}"] = Target(folder, relative, (read, check_dataset))
    return made


def examine(target: Target, content: bytes, place: Path) -> int:
    """Read a data set with one file replaced; return how many of its readers accepted the file."""
    folder = place / "spoilt"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(target.folder, folder)
    (folder / target.file).write_bytes(content)
    num_taken = 0
    for read in target.reads:
        line = ""
        try:
            read(folder)
            num_taken += 1
        except UserError as error:
            line = str(error)
        assert "\n" not in line
        assert len(line) < MOST_CHARACTERS
    return num_taken


def fuzz(target: Target, folder: Path, num_files: int) -> None:
    """Damage a good file in many ways; few damages are the same in every run."""
    good = (target.folder / target.file).read_bytes()
    num_taken = examine(target, good, folder)
    # Not every reader of images accepts every format.
    assert num_taken == len(target.reads) or (num_taken and len(target.reads) > 2)

    @settings(
        max_examples=num_files, derandomize=num_files == QUICK, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(damage())
    def check(steps: list[tuple[str, float, Any]]) -> None:
        examine(target, damaged(good, steps), folder)

    check()


MANY = pytest.param(THOROUGH, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])


@pytest.mark.parametrize("num_files", [QUICK, MANY])
@pytest.mark.parametrize("name", NAMES)
def test_damaged_files(name, num_files, targets, tmp_path):
    fuzz(targets[name], tmp_path, num_files)


def test_every_undamaged_file_is_read(targets):
    assert set(targets) == set(NAMES)
