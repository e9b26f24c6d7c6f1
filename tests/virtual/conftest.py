"""Solids and scenes that the tests of the virtual factory share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import camera_matrix
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.virtual import Ambient, Light, Scene, SceneObject, Surface, make_surface


def mesh_of(solid: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(solid.vertices), np.asarray(solid.faces, np.int32))


@pytest.fixture(scope="session")
def surface_of() -> Callable[[trimesh.Trimesh], Surface]:
    return lambda solid: make_surface(mesh_of(solid))


@pytest.fixture(scope="session")
def sized_box() -> Callable[[str, float], Part]:
    """Make a box-shaped part, 10 cm long at size 1."""
    mesh = mesh_of(trimesh.creation.box((0.10, 0.06, 0.02)))
    return lambda name, size: make_part(name, replace(mesh, vertices=mesh.vertices * size))


@pytest.fixture(scope="session")
def box_part(sized_box: Callable[[str, float], Part]) -> Part:
    return sized_box("box", 1.0)


@pytest.fixture(scope="session")
def box_surface(box_part: Part) -> Surface:
    assert box_part.mesh is not None
    return make_surface(box_part.mesh)


@pytest.fixture(scope="session")
def parts() -> list[Part]:
    return [servoholder(), pivconnector()]


@pytest.fixture(scope="session")
def sheet() -> Callable[..., Mesh]:
    """Make a square in the xy plane whose uv grow with x and y; its front looks along +z."""

    def make(size: float, texture: np.ndarray | None = None) -> Mesh:
        corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)
        faces = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
        return Mesh(corners * size / 2, faces, (corners[:, :2] + 1) / 2, texture)

    return make


@pytest.fixture(scope="session")
def scene_of() -> Callable[..., Scene]:
    """Make a 160×120 scene with a principal point off the pixel grid and a grey background."""

    def make(
        *objects: SceneObject,
        size: tuple[int, int] = (160, 120),
        focal: float = 160.0,
        lights: tuple[Light, ...] = (Light((0.2, -0.4, -0.2)),),
        ambient: Ambient | None = None,
    ) -> Scene:
        K = camera_matrix(focal, 1.02 * focal, size[0] / 2 - 0.8, size[1] / 2 + 0.3)
        background = np.full((size[1], size[0], 3), 90, np.uint8)
        return Scene(K, background, objects, lights, ambient or Ambient())

    return make
