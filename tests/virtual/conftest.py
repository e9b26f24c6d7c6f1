"""Solids and scenes that the tests of the virtual factory share."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import camera_matrix
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import Mesh, make_part
from dopepp.virtual import Factory, Scene, make_surface
from dopepp.virtual.scene import Ambient, Light
from tests.parts.makers import mesh_of

LAMP = Light((0.2, -0.4, -0.2))


@pytest.fixture(scope="session")
def surface_of():
    return lambda solid: make_surface(mesh_of(solid))


@pytest.fixture(scope="session")
def sized_box():
    """Make a box-shaped part, 10 cm long at size 1."""
    mesh = mesh_of(trimesh.creation.box((0.10, 0.06, 0.02)))
    return lambda name, size: make_part(name, replace(mesh, vertices=mesh.vertices * size))


@pytest.fixture(scope="session")
def box_part(sized_box):
    return sized_box("box", 1.0)


@pytest.fixture(scope="session")
def box_surface(box_part):
    return make_surface(box_part.mesh)


@pytest.fixture(scope="session")
def parts():
    return [servoholder(), pivconnector()]


@pytest.fixture(scope="session")
def sheet():
    """Make a square in the xy plane whose uv grow with x and y; its front looks along +z."""

    def make(size, texture=None):
        corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)
        faces = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
        return Mesh(corners * size / 2, faces, (corners[:, :2] + 1) / 2, texture)

    return make


def even_light(level, **fields):
    """Return ambient light of one level from above and below."""
    return Ambient(above=(level,) * 3, below=(level,) * 3, **fields)


def pixel_rays(scene):
    """Return the rays of every pixel, (height, width, 3)."""
    v, u = np.mgrid[: scene.size[1], : scene.size[0]]
    return np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(scene.K).T


def draw_scenes(parts, preset, seed, count, *options):
    """Return the first scenes of a factory."""
    factory = Factory(parts, preset, seed, *options)
    return [factory.scene(0, index) for index in range(count)]


@pytest.fixture(scope="session")
def scene_of():
    """Make a 160×120 scene with a principal point off the pixel grid and a grey background."""

    def make(*objects, size=(160, 120), focal=160.0, lights=(LAMP,), ambient=None):
        K = camera_matrix(focal, 1.02 * focal, size[0] / 2 - 0.8, size[1] / 2 + 0.3)
        background = np.full((size[1], size[0], 3), 90, np.uint8)
        return Scene(K, background, objects, lights, ambient or Ambient())

    return make
