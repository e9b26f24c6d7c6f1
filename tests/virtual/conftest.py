from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import camera_matrix
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.virtual import Ambient, Light, Scene, SceneObject


def box_mesh(extents: tuple[float, float, float]) -> Mesh:
    box = trimesh.creation.box(extents)
    return Mesh(np.asarray(box.vertices), np.asarray(box.faces, np.int32))


@pytest.fixture(scope="session")
def box_part() -> Part:
    return make_part("box", box_mesh((0.10, 0.06, 0.02)))


@pytest.fixture
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
