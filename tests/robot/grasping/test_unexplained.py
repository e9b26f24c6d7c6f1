"""Regions in the parts' colours that no detected part covers."""

import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import camera_matrix, make_transform
from dopepp.inference.refinement.outline import filled_mask, make_outline_mesh, posed
from dopepp.robot.grasping.unexplained import Unexplained, find_unexplained

BOX = trimesh.creation.box((0.04, 0.03, 0.02))
MESH = make_outline_mesh(BOX.vertices, BOX.faces)
K = camera_matrix(600, 600, 319.5, 239.5)
LEFT, RIGHT = (make_transform(np.eye(3), np.array([x, 0.0, 0.3])) for x in (-0.05, 0.05))
PART, BENCH = (150, 60, 40), (90, 120, 130)


def silhouette(pose: np.ndarray) -> np.ndarray:
    posed_mesh = posed(MESH, pose, K)
    assert posed_mesh is not None
    return filled_mask(MESH, posed_mesh, (640, 480)) == 1


def picture(bench: tuple[int, int, int] = BENCH) -> np.ndarray:
    """Return a noisy image of both boxes."""
    image = np.full((480, 640, 3), bench, float)
    image[silhouette(LEFT) | silhouette(RIGHT)] = PART
    noise = np.random.default_rng(0).normal(0, 4, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def test_an_undetected_part_is_a_region():
    mask = find_unexplained(picture(), K, MESH, [LEFT])
    hidden = silhouette(RIGHT)
    assert mask[hidden].mean() > 0.95
    assert mask[~hidden].mean() < 0.002  # a border, because colours are smoothed


def test_detected_parts_explain_their_pixels():
    assert find_unexplained(picture(), K, MESH, [LEFT, RIGHT]).sum() == 0


@pytest.mark.parametrize(("bench", "poses"), [(PART, [LEFT]), (BENCH, [])])
def test_without_distinct_colours_or_detections_there_is_no_region(bench, poses):
    assert find_unexplained(picture(bench), K, MESH, poses).sum() == 0


@pytest.mark.parametrize(
    ("x", "y", "opening", "is_blocked"),
    [
        (0.05, 0.0, 0.01, True),  # both fingers on the part
        (0.05, 0.0, 0.05, False),  # the part is between the fingers
        (0.02, 0.0, 0.05, True),  # one finger on the part
        (-0.05, 0.0, 0.01, False),  # at the detected part
        (0.05, 0.04, 0.01, False),  # beside the part
    ],
)
def test_fingers_do_not_enter_regions(x, y, opening, is_blocked):
    regions = Unexplained(find_unexplained(picture(), K, MESH, [LEFT]), K, np.eye(4))
    tool = make_transform(np.eye(3), np.array([x, y, 0.3]))  # the approach is the optical axis
    assert regions.blocks(tool, opening) is is_blocked
