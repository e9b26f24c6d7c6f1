import numpy as np
import pytest
import torch

from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints, transform
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.rotation import random_rotation
from dopepp.maps import MapGeometry, encode
from dopepp.recovery import recover


class Scene:
    """Poses of objects, and their perfect maps."""

    def __init__(self, cuboids, K):
        self.cuboids, self.K = np.stack(cuboids), K
        self.objects, self.poses = [], []

    def place(self, index, T_cam_obj):
        self.objects.append(index)
        self.poses.append(T_cam_obj)
        return self

    def maps(self, sigma=1.0, field_radius=2.0):
        placed = zip(self.objects, self.poses, strict=True)
        points = [project_keypoints(self.cuboids[index], T, self.K) for index, T in placed]
        belief, field = encode(
            torch.tensor(np.array(points))[None], torch.tensor(self.objects)[None],
            len(self.cuboids), (52, 52), MapGeometry(8, sigma, field_radius),
        )  # fmt: skip
        return belief[0], field[0]

    def recover(self, belief=None, field=None, **options):
        """Recover the poses from the given maps, or from the perfect ones."""
        maps = self.maps() if belief is None else (belief, field)
        return recover(*maps, self.cuboids, self.K, **options)

    def errors(self, index, T_cam_obj):
        """Return the ADD between a pose and each instance of an object, diameters of the cuboid."""
        cuboid = self.cuboids[index]
        moved, diameter = transform(T_cam_obj, cuboid), np.linalg.norm(cuboid[0] - cuboid[6])
        return [
            float(np.linalg.norm(moved - transform(T, cuboid), axis=1).mean() / diameter)
            for c, T in zip(self.objects, self.poses, strict=True)
            if c == index
        ]

    def error(self, index, T_cam_obj):
        """Return the ADD between a pose and the nearest instance, diameters of the cuboid."""
        return min(self.errors(index, T_cam_obj))


@pytest.fixture(name="K")
def camera():
    return camera_matrix(500, 510, 207.5, 205.0)


@pytest.fixture
def box():
    return cuboid_keypoints(np.array([-0.04, -0.03, -0.05]), np.array([0.04, 0.03, 0.05]))


@pytest.fixture
def plate():
    half = np.array([0.0525, 0.026, 0.0035])
    return cuboid_keypoints(-half, half)


@pytest.fixture
def pose():
    def draw(rng, x=0.0, y=0.0, z=0.4):
        """Return a random rotation at a position (metres), shifted by up to a centimetre."""
        R = random_rotation(rng)
        return make_transform(R, rng.uniform(-0.01, 0.01, 3) + np.array([x, y, z]))

    return draw


@pytest.fixture
def make_scene(K):
    return lambda *cuboids, camera=K: Scene(cuboids, camera)
