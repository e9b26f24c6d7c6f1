from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.exchange.stl import export_stl

from dopepp.geometry.camera import make_transform
from dopepp.parts import load_part
from dopepp.virtual import Scene, SceneObject, make_surface, render

AWAY = np.array([0.0, 0.0, 0.4])


def middle_depth(path: Path, scene_of: Callable[..., Scene], turn: np.ndarray) -> float:
    mesh = load_part(path, "mm").mesh
    assert mesh is not None
    scene = scene_of(SceneObject(make_surface(mesh), make_transform(turn, AWAY)))
    return float(render(scene).depth[60, 80])


def test_an_open_mesh_shows_both_sides(
    tmp_path: Path, scene_of: Callable[..., Scene], caplog: pytest.LogCaptureFixture
) -> None:
    box = trimesh.creation.box((100, 100, 60))
    box.update_faces(box.face_normals[:, 2] > -0.5)  # no bottom
    (tmp_path / "open.stl").write_bytes(export_stl(box))
    with caplog.at_level(logging.INFO):
        into = middle_depth(tmp_path / "open.stl", scene_of, np.eye(3))
    assert "4 open edges" in caplog.text
    assert into == pytest.approx(0.43, abs=1e-4)  # the lid, from its inside
    onto = middle_depth(tmp_path / "open.stl", scene_of, np.diag([1.0, -1.0, -1.0]))
    assert onto == pytest.approx(0.37, abs=1e-4)


@pytest.mark.parametrize("inside_out", [False, True])
def test_bodies_through_each_other_show_their_outside(
    tmp_path: Path, scene_of: Callable[..., Scene], inside_out: bool
) -> None:
    slab, pin = trimesh.creation.box((100, 100, 20)), trimesh.creation.box((30, 30, 80))
    if inside_out:
        pin.invert()
    both = trimesh.util.concatenate([slab, pin])
    (tmp_path / "both.stl").write_bytes(export_stl(both))
    assert middle_depth(tmp_path / "both.stl", scene_of, np.eye(3)) == pytest.approx(0.36, abs=1e-4)
