from __future__ import annotations

import numpy as np
import pytest

from dopepp.parts.mesh.polygons import fans, first_folded_polygon


def test_fans_lie_around_first_corners() -> None:
    triangles, polygons = fans(np.array([3, 5, 4]))
    assert triangles.tolist() == [
        [0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 6, 7], [8, 9, 10], [8, 10, 11]
    ]  # fmt: skip
    assert polygons.tolist() == [0, 1, 1, 1, 2, 2]
    with pytest.raises(ValueError, match="face 1 of fewer than 3 corners"):
        fans(np.array([3, 2]))


def test_a_face_of_a_vertex_that_is_not_there_is_not_judged() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 4]])
    assert first_folded_polygon(np.eye(4)[:, :3], faces, np.array([0, 0])) is None


def test_a_fan_over_a_dent_is_folded() -> None:
    square = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    dart = np.array([[2.0, 0, 1], [0.5, 0.5, 1], [0, 2, 1], [0, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    polygons = np.array([3, 3, 8, 8])
    assert first_folded_polygon(np.vstack([square, dart]), faces, polygons) == 8
    assert first_folded_polygon(np.vstack([square, square]), faces, polygons) is None
    bow_tie = square[[0, 2, 1, 3]]
    assert first_folded_polygon(np.vstack([square, bow_tie]), faces, polygons) == 8
