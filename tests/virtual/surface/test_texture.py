"""Filtered textures against a heavily supersampled reference, near, far and at grazing angles."""

from dataclasses import replace

import numpy as np
import pytest

from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.virtual import SceneObject, make_surface, render
from dopepp.virtual.presets.placement import FACING
from dopepp.virtual.scene import Material
from dopepp.virtual.sensor import decode_srgb, encode_srgb
from dopepp.virtual.surface.texture import make_texture
from tests.virtual.conftest import even_light

SIDE = 0.3
DIM = even_light(0.4)


def supersampled(texture, pose, scene, n=12):
    """Mean linear texel under n×n rays a pixel; NaN where some of them miss the sheet."""
    width, height = scene.size
    v, u = np.mgrid[:height, :width]
    inverse_K, rotation = np.linalg.inv(scene.K), pose[:3, :3]
    start, light, total = -rotation.T @ pose[:3, 3], decode_srgb(texture / 255), 0.0
    for dx, dy in (np.mgrid[:n, :n].reshape(2, -1).T + 0.5) / n - 0.5:
        rays = np.stack([u + dx, v + dy, np.ones_like(u)], axis=-1) @ inverse_K.T @ rotation
        stretch = -start[2] / rays[..., 2]
        place = (start + stretch[..., None] * rays)[..., :2] / SIDE + 0.5
        inside = (stretch > 0) & ((place >= 0) & (place < 1)).all(axis=-1)
        cell = np.where(inside[..., None], place, 0) * (texture.shape[1], texture.shape[0])
        column, row = cell[..., 0].astype(int), texture.shape[0] - 1 - cell[..., 1].astype(int)
        total = total + np.where(inside[..., None], light[row, column], np.nan)
    return np.asarray(total) / n**2


@pytest.mark.parametrize(("angle", "distance"), [(0, 0.8), (55, 0.6), (75, 0.5), (82, 0.8)])
def test_a_fine_checker_matches_supersampling(scene_of, sheet, angle, distance):
    tiles = np.indices((80, 80)).sum(axis=0) % 2
    texture = (np.kron(tiles, np.ones((3, 3)))[..., None].repeat(3, -1) * 200 + 30).astype(np.uint8)
    tilt = rotation_vector_to_matrix(np.array([np.radians(angle), 0, 0]))
    turn = rotation_vector_to_matrix(np.array([0, 0, 0.3]))
    pose = make_transform(tilt @ turn @ FACING, np.array([0, 0, distance]))
    item = SceneObject(make_surface(sheet(SIDE, texture)), pose, Material((1, 1, 1), 1.0, 0.0))
    scene = scene_of(item, lights=(), ambient=DIM)
    expected = 255 * encode_srgb(0.4 * supersampled(texture, pose, scene))
    known = np.isfinite(expected)
    assert known.sum() > 400
    point_sampled = 255 * encode_srgb(0.4 * supersampled(texture, pose, scene, 1))
    off, off_sampled = (image - expected for image in (render(scene).image, point_sampled))
    error = np.sqrt((off[known] ** 2).mean())
    assert error < min(12, np.sqrt((off_sampled[known] ** 2).mean()) / 4)


def test_unused_texels_leave_no_seams(scene_of, sheet):
    # Only the left half of the texture is used; the rest must not be visible.
    texture = np.full((128, 128, 3), (120, 120, 120), np.uint8)
    texture[:, 64:] = (255, 0, 255)
    mesh, pose = sheet(SIDE, texture), make_transform(FACING, np.array([0, 0, 4.0]))
    surface = make_surface(replace(mesh, uv=mesh.uv * (0.5, 1.0)))
    item = SceneObject(surface, pose, Material((1, 1, 1), 1, 0))
    rendered = render(scene_of(item, lights=(), ambient=DIM))
    seen = rendered.image[rendered.instances == 0].astype(int)
    assert len(seen) > 50
    assert (seen[:, 0] - seen[:, 1]).max() <= 1


@pytest.mark.parametrize("shape", [(64, 64), (37, 101), (1, 5), (1, 1)])
def test_the_coarsest_level_is_the_mean_light(shape):
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3)).astype(np.uint8)
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    texture = make_texture(image, uv, np.array([(0, 1, 2), (0, 2, 3)], np.int32))
    assert texture.image(-1).shape == (1, 1, 3)
    np.testing.assert_array_equal(texture.image(), image)
    expected = 255 * encode_srgb(decode_srgb(image / 255).mean(axis=(0, 1)))
    np.testing.assert_allclose(texture.image(-1)[0, 0], expected, atol=3)
