"""Draw the image at the top of the README: STL → renders → belief maps → pose.

python docs/make_chain_picture.py
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from dopepp import PoseEstimator
from dopepp.core.files import write_image
from dopepp.data.rendered import RenderedSource
from dopepp.drawing.overlay import Wireframe, overlay
from dopepp.drawing.pictures import RGBImage
from dopepp.drawing.sheet import Tile, contact_sheet, grid, heat_image
from dopepp.geometry.camera import camera_matrix, make_transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.parts import Part, pivconnector
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.renderers import find_renderer
from dopepp.virtual.scene import Light, Material, Scene, SceneObject
from dopepp.virtual.surface import make_surface

TARGET = Path(__file__).parent / "images" / "chain.jpg"
SIDE = 320
"""Pixels of each of the four panels."""

SEED, INDEX = 2024, 12
"""Seed and index of a scene that was not used in training."""


def part_on_white(part: Part) -> RGBImage:
    """Render a part on a white background, viewed from above its face."""
    assert part.mesh is not None
    K = camera_matrix(2.6 * SIDE, 2.6 * SIDE, (SIDE - 1) / 2, (SIDE - 1) / 2)
    R = Rotation.from_euler("xyz", [205, 25, 20], degrees=True).as_matrix()
    body = SceneObject(
        make_surface(part.mesh),
        make_transform(R, np.array([0, 0, 0.32])),
        Material(colour=(0.45, 0.5, 0.56)),
        part,
    )
    white = np.full((SIDE, SIDE, 3), 255, np.uint8)
    scene = Scene(K, white, (body,), (Light((-0.3, -0.5, -0.1), (0.9, 0.9, 0.9), 0.6),))
    return find_renderer("raster")(scene).image


def chain() -> RGBImage:
    """Return the image with its four panels."""
    part, preset = pivconnector(), PRESETS["quickstart"]
    estimator = PoseEstimator.load("pretrained/pivconnector", refine="region")
    training = Factory([part], preset.resized(SIDE // 2, SIDE // 2), seed=1)
    renders = grid([training.render(0, index).image for index in range(4)], columns=2)
    scene = RenderedSource(Factory([part], preset.resized(SIDE, SIDE), SEED), 20).sample(INDEX)
    small = cv2.resize(scene.image, estimator.checkpoint.input_size, interpolation=cv2.INTER_AREA)
    beliefs = estimator.maps(np.asarray(small, np.uint8))[0].numpy()[:CENTROID].max(axis=0)
    pose = estimator.predict(scene.image, scene.K)[0]
    tiles = [
        Tile(part_on_white(part), "an STL"),
        Tile(renders, "renders, which a network learns"),
        Tile(heat_image(scene.image, beliefs, SIDE // beliefs.shape[0]),
             "where it believes corners on a new image"),
        Tile(overlay(scene.image, [Wireframe(pose.keypoints)], SIDE), "the pose, refined"),
    ]  # fmt: skip
    return contact_sheet(tiles, columns=4, tile_width=SIDE)


if __name__ == "__main__":
    write_image(TARGET, chain())
