"""The OpenGL renderer against the rasteriser, on whatever OpenGL there is (here llvmpipe)."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dopepp.parts.catalogue import BUILTIN
from dopepp.parts.mesh import read_mesh
from dopepp.parts.part import Part
from dopepp.virtual import (
    PRESETS,
    Factory,
    Grooves,
    Light,
    Material,
    Plane,
    Rendered,
    Scene,
    SceneObject,
    make_surface,
    render,
)

pytest.importorskip("moderngl", reason="the extra gl is not installed")

from dopepp.errors import UserError
from dopepp.virtual import gl, gl_context

pytestmark = pytest.mark.render


@pytest.fixture(scope="module", autouse=True)
def opengl() -> None:
    """Skip where the machine has no OpenGL at all, not even in software."""
    try:
        context = gl_context.open_context(admit_software=True)
    except UserError as error:
        pytest.skip(str(error))
    context.release()


def drawn(scene: Scene) -> Rendered:
    return gl.render(scene, admit_software=True)


def assert_alike(scene: Scene, mean: float = 1.0) -> None:
    expected, found = render(scene), drawn(scene)
    assert (np.abs(found.depth - expected.depth) < 1e-3).mean() >= 0.995
    assert (found.instances == expected.instances).mean() >= 0.995
    np.testing.assert_allclose(found.visible_fractions, expected.visible_fractions, atol=0.02)
    covered = expected.instances >= 0
    error = np.abs(found.image.astype(int) - expected.image)
    assert not covered.any() or error[covered].mean() < mean, error[covered].mean()
    assert error[~covered].mean() < mean
    assert found.image.dtype == np.uint8
    assert found.depth.dtype == np.float32
    assert found.instances.dtype == np.int16


def posed(z: float = 0.3, turn: float = 0.6) -> np.ndarray:
    cos, sin = np.cos(turn), np.sin(turn)
    T = np.eye(4)
    T[:3, :3] = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]) @ np.array(
        [[1, 0, 0], [0, cos, -sin], [0, sin, cos]]
    )
    T[:3, 3] = 0.01, -0.01, z
    return T


@pytest.mark.parametrize("preset", ["paper", "table", "bin"])
def test_random_scenes_look_like_the_rasterisers(preset: str) -> None:
    parts = [make() for make in BUILTIN.values()]
    factory = Factory(parts, PRESETS[preset].resized(320, 240), seed=4)
    for index in range(3):
        assert_alike(factory.scene(0, index))


@pytest.mark.parametrize(
    "material",
    [
        Material(noise=0.4, noise_pitch=0.01),
        Material(metallic=1.0, roughness=0.2, colour=(0.9, 0.7, 0.4)),
        Material(grooves=Grooves(axis=(1.0, 0.0, 0.0), pitch=0.03, slope=0.5)),
        Material(metallic=1.0, grooves=Grooves(pitch=0.0002, slope=0.3, irregularity=1.0)),
    ],
)
def test_materials_look_alike(
    material: Material, box_part: Part, scene_of: Callable[..., Scene]
) -> None:
    assert box_part.mesh is not None
    item = SceneObject(make_surface(box_part.mesh), posed(), material, box_part)
    lights = (Light((0.2, -0.4, -0.2)), Light((-0.5, -0.3, 0.1), (0.2, 0.3, 0.4)))
    assert_alike(scene_of(item, lights=lights))
    assert_alike(scene_of(item, lights=()))


def test_a_textured_model_looks_alike(ycb_root: Path, scene_of: Callable[..., Scene]) -> None:
    mesh = read_mesh(ycb_root / "models" / "003_cracker_box" / "textured.obj", "m")
    scene = scene_of(SceneObject(make_surface(mesh), posed(z=0.6)))
    # Filters differ in their widths, so fine print differs where it is sharpest.
    assert_alike(scene, mean=4.0)


def test_an_open_mesh_shows_its_back(box_part: Part, scene_of: Callable[..., Scene]) -> None:
    mesh = box_part.mesh
    assert mesh is not None
    opened = make_surface(replace(mesh, faces=mesh.faces[4:]))
    assert not opened.closed
    for turn in (0.6, 2.0, 3.6):
        assert_alike(scene_of(SceneObject(opened, posed(turn=turn))))


def test_a_plane_hides_what_lies_below_it(box_part: Part, scene_of: Callable[..., Scene]) -> None:
    assert box_part.mesh is not None
    scene = scene_of(SceneObject(make_surface(box_part.mesh), posed()))
    assert_alike(replace(scene, plane=Plane((0.0, 0.0, -1.0), -0.3)))


def test_an_object_around_the_camera_is_cut(box_part: Part, scene_of: Callable[..., Scene]) -> None:
    assert box_part.mesh is not None
    assert_alike(scene_of(SceneObject(make_surface(box_part.mesh), posed(z=0.02))), mean=2.0)


def test_an_empty_scene_is_its_background(scene_of: Callable[..., Scene]) -> None:
    scene = scene_of()
    found = drawn(scene)
    np.testing.assert_array_equal(found.image, scene.background)
    assert (found.instances == -1).all()
    assert not found.depth.any()


def test_the_same_scene_gives_the_same_bytes(
    box_part: Part, scene_of: Callable[..., Scene]
) -> None:
    assert box_part.mesh is not None
    scene = scene_of(SceneObject(make_surface(box_part.mesh), posed(), part=box_part))
    first, second = drawn(scene), drawn(pickle.loads(pickle.dumps(scene)))
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.depth, second.depth)


def test_memory_goes_with_its_surface(box_part: Part, scene_of: Callable[..., Scene]) -> None:
    assert box_part.mesh is not None
    renderer = gl.Renderer(gl_context.open_context(admit_software=True))
    renderer.render(scene_of(SceneObject(make_surface(box_part.mesh), posed())))
    assert renderer.num_meshes == 0


def test_rendering_needs_no_torch() -> None:
    code = (
        "import sys; from dopepp.virtual import gl; "
        "sys.exit(any(name in sys.modules for name in ('torch', 'lightning')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
