"""Widths of thin features against widths of known solids."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dopepp.parts.part import make_part
from dopepp.virtual.thinness import thin_width
from tests.parts.makers import mesh_of


def width_of(solid):
    return thin_width(make_part("solid", mesh_of(solid)))


def test_a_ball_is_as_wide_as_its_silhouette():
    assert width_of(trimesh.creation.icosphere(4, 0.03)) == pytest.approx(1.0, abs=0.03)


def test_a_rod_is_as_wide_as_its_section():
    rod = trimesh.creation.cylinder(0.004, 0.16)
    assert width_of(rod) == pytest.approx(0.008 / 0.16, abs=0.01)


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_width_is_relative_to_the_diameter(scale):
    solid = trimesh.creation.box((0.05, 0.03, 0.01))
    assert width_of(solid.copy().apply_scale(scale)) == pytest.approx(width_of(solid), abs=1e-6)


def test_the_handle_of_a_tool_is_found_beside_its_head():
    head = trimesh.creation.cylinder(0.012, 0.03)
    handle = trimesh.creation.cylinder(0.004, 0.12)
    handle.apply_transform(trimesh.transformations.translation_matrix([0, 0, 0.07]))
    tool = trimesh.util.concatenate([head, handle])
    assert 0.04 < width_of(tool) < 0.08 < width_of(head)


def test_a_turned_part_has_nearly_the_same_width():
    solid = trimesh.creation.box((0.08, 0.02, 0.01))
    turned = solid.copy()
    turned.apply_transform(
        np.block([[Rotation.random(random_state=3).as_matrix(), np.zeros((3, 1))], [0, 0, 0, 1]])
    )
    assert width_of(turned) == pytest.approx(width_of(solid), rel=0.25)
