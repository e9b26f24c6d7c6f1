"""Visible fractions against closed forms: truncation and occlusion both count."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import make_transform
from dopepp.parts.part import Mesh
from dopepp.virtual import Scene, SceneObject, Surface, render, visible_fractions

MakeScene = Callable[..., Scene]
IMAGE = {"size": (640, 480), "focal": 600.0}


@pytest.fixture(scope="module")
def sheet() -> Surface:
    from dopepp.virtual import make_surface

    box = trimesh.creation.box((0.10, 0.06, 1e-4))
    return make_surface(Mesh(np.asarray(box.vertices), np.asarray(box.faces)))


def at(surface: Surface, x: float, y: float, z: float) -> SceneObject:
    return SceneObject(surface, make_transform(np.eye(3), np.array([x, y, z])))


def x_of(scene: Scene, u: float, depth: float) -> float:
    return float((u - scene.K[0, 2]) / scene.K[0, 0] * depth)


def test_whole_object_is_fully_visible(scene_of: MakeScene, sheet: Surface) -> None:
    assert render(scene_of(at(sheet, 0, 0, 0.3), **IMAGE)).visible_fractions[0] == 1.0
    pair = scene_of(at(sheet, 0, -0.04, 0.3), at(sheet, 0, 0.04, 0.3), **IMAGE)
    np.testing.assert_array_equal(render(pair).visible_fractions, [1.0, 1.0])


@pytest.mark.parametrize("share", [0.5, 0.25])
def test_truncated_by_the_image_border(scene_of: MakeScene, sheet: Surface, share: float) -> None:
    # The image ends at u = −0.5: put the box so that the asked share of its width is beyond it.
    edge = x_of(scene_of(**IMAGE), -0.5, 0.3)
    scene = scene_of(at(sheet, edge + (share - 0.5) * 0.10, 0, 0.3), **IMAGE)
    assert render(scene).visible_fractions[0] == pytest.approx(share, abs=0.005)


def test_half_occluded(scene_of: MakeScene, sheet: Surface) -> None:
    # Seen from the camera, the near box's left edge passes through the far box's centre.
    near = at(sheet, 0.05, 0, 0.2)
    far = at(sheet, 0, 0, 0.3)
    fractions = render(scene_of(near, far, **IMAGE)).visible_fractions
    np.testing.assert_allclose(fractions, [1.0, 0.5], atol=0.005)


def test_hidden_or_outside_is_zero(scene_of: MakeScene, sheet: Surface) -> None:
    scene = scene_of(
        at(sheet, 0, 0, 0.2), at(sheet, 0, 0, 0.4), at(sheet, 5, 0, 0.4), at(sheet, 0, 0, -1),
        **IMAGE,
    )  # fmt: skip
    np.testing.assert_array_equal(render(scene).visible_fractions, [1, 0, 0, 0])
    lone = scene_of(at(sheet, 0, 0, -1), **IMAGE)
    np.testing.assert_array_equal(render(lone).visible_fractions, [0])


def test_a_huge_silhouette_is_counted_at_a_reduced_scale(
    scene_of: MakeScene, sheet: Surface
) -> None:
    # At 2 cm the box is 3,000 × 1,800 px, of which the image shows 640 × 480.
    fraction = render(scene_of(at(sheet, 0, 0, 0.02), **IMAGE)).visible_fractions[0]
    near_face = 0.02 - 0.5e-4
    area = (600 * 0.10 / near_face) * (1.02 * 600 * 0.06 / near_face)
    assert fraction == pytest.approx(640 * 480 / area, rel=0.01)


def test_preview_agrees_with_rendering(scene_of: MakeScene, sheet: Surface) -> None:
    scene = scene_of(at(sheet, 0.05, 0, 0.2), at(sheet, 0, 0.01, 0.3), **IMAGE)
    np.testing.assert_array_equal(visible_fractions(scene), render(scene).visible_fractions)
