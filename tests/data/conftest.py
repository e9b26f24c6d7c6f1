"""Fixtures: miniature data sets, samples, parts and render jobs."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
import trimesh
from scipy.spatial.transform import Rotation

from dopepp.data.rendered import rendered_sample
from dopepp.data.sample import Instance, Sample, SourceInfo
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import Part, make_part
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS
from dopepp.virtual.renderers.raster import silhouette
from dopepp.virtual.scene import SceneObject
from dopepp.virtual.surface import make_surface
from tests.data.makers import pose_at
from tests.parts.makers import mesh_of

HALF = np.array([0.04, 0.03, 0.02])


@pytest.fixture
def box():
    cuboid = cuboid_keypoints(-HALF, HALF)
    return Part("003_box", cuboid, float(2 * np.linalg.norm(HALF)), cuboid[:8], mesh_hash="box")


@dataclass(eq=False)
class FakeSource:
    """Small textured images with one instance, a pure function of (epoch, index)."""

    num_items: int = 12
    name: str = "fake"
    label: str = "box"
    size: tuple[int, int] = (64, 48)
    bad: Callable[[int], Exception | None] = lambda index: None
    calls: list[tuple[int, int]] = field(default_factory=list)

    def __len__(self) -> int:
        return self.num_items

    def sample(self, index: int, epoch: int = 0) -> Sample:
        self.calls.append((epoch, index))
        if error := self.bad(index):
            raise error
        rng = np.random.default_rng([7, epoch, index])
        width, height = self.size
        image = rng.integers(0, 256, (height, width, 3), np.uint8)
        K = camera_matrix(width, width, (width - 1) / 2, (height - 1) / 2)
        T = pose_at(*np.add(rng.uniform(-0.02, 0.02, 3), (0, 0, 0.25)))
        keypoints = project_keypoints(cuboid_keypoints(-HALF, HALF), T, K)
        mask = np.zeros((height, width), bool)
        low, high = np.nanmin(keypoints, axis=0), np.nanmax(keypoints, axis=0)
        mask[max(0, int(low[1])) : int(high[1]) + 1, max(0, int(low[0])) : int(high[0]) + 1] = True
        instance = Instance(self.label, T, keypoints, 0.9, mask)
        return Sample(image, K, [instance], source=self.name, key=f"{epoch}/{index}")

    def contains(self, label: str) -> bool:
        return label == self.label

    def describe(self) -> list[SourceInfo]:
        return [SourceInfo(self.name, self.num_items, {"label": self.label}, {self.label: 1})]


@pytest.fixture
def fake_source():
    return FakeSource


class YcbTree:
    """Writes a tiny YCB-Video folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for folder in ("data", "data_syn", "image_sets"):
            (root / folder).mkdir(parents=True)
        self.write_list("classes", ["002_can", "003_box", "004_mug"])
        self.K = camera_matrix(100.0, 100.0, 47.5, 35.5)

    def write_list(self, name: str, lines: list[str]) -> None:
        (self.root / "image_sets" / f"{name}.txt").write_text("\n".join(lines) + "\n")

    def path(self, frame: str, what: str) -> Path:
        folder = "" if frame.startswith("data_syn") else "data/"
        return self.root / f"{folder}{frame}-{what}"

    def write(
        self, frame: str, classes: tuple[int, ...] = (2,), *, labelled: bool = True, **changes: Any
    ) -> np.ndarray:
        """Write a 96×72 frame of boxes; return the poses (3, 4, N)."""
        rng = np.random.default_rng(5)
        image = rng.integers(0, 256, (72, 96, 3), np.uint8)
        label = np.zeros((72, 96), np.uint8)
        poses = np.zeros((3, 4, len(classes)))
        for i, class_index in enumerate(classes):
            T = pose_at(0.04 * i, 0.0, 0.3)
            poses[..., i] = T[:3]
            corners = project_keypoints(cuboid_keypoints(-HALF, HALF), T, self.K)[:8]
            if labelled:
                hull = cv2.convexHull(np.rint(corners).astype(np.int32))
                cv2.fillConvexPoly(label, hull, class_index)
        if frame.startswith("data_syn"):
            image = np.dstack([image, np.where(label > 0, 255, 0).astype(np.uint8)])
            image[label == 0] = 0
        self.path(frame, "color.png").parent.mkdir(exist_ok=True)
        order = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
        colour, depth = cv2.cvtColor(image, order), np.full(label.shape, 3000, np.uint16)
        for what, pixels in (("color", colour), ("label", label), ("depth", depth)):
            cv2.imwrite(str(self.path(frame, f"{what}.png")), pixels)
        fields: dict[str, Any] = {
            "cls_indexes": np.array(classes, np.float32)[:, None],
            "poses": poses,
            "intrinsic_matrix": self.K,
            "factor_depth": 10000,
            "vertmap": rng.random((72, 96, 3)).astype(np.float32),
        } | changes
        fields = {name: value for name, value in fields.items() if value is not None}
        scipy.io.savemat(self.path(frame, "meta.mat"), fields, do_compression=True)
        return poses


@pytest.fixture
def ycb_tree(tmp_path):
    return YcbTree(tmp_path / "ycb")


BOX = trimesh.creation.box((60.0, 40.0, 24.0))  # mm, with its centre beside the origin
BOX.apply_translation((4.0, -6.0, 2.0))


@pytest.fixture(scope="session")
def parts():
    return [servoholder(), pivconnector()]


@pytest.fixture(scope="session")
def samples(parts):
    """Four images of bins, with many instances each."""
    factory = Factory(parts, PRESETS["bin"].resized(160, 120), seed=4)
    return [rendered_sample(factory.render(0, i), "virtual", str(i)) for i in range(4)]


@pytest.fixture(scope="session")
def boxes():
    """Two boxes of 60 × 40 × 24 mm, and three images of both, the second in front of the first."""
    mesh = mesh_of(BOX, scale=0.001)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])[None]
    axis = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    parts = [
        make_part("obj_000001", mesh, symmetries_discrete=half_turn),
        make_part("obj_000002", mesh, symmetries_continuous=(axis,)),
    ]
    return parts, [_boxes_at(parts, image) for image in range(3)]


def _boxes_at(parts, image):
    rng, K, size = np.random.default_rng(image), camera_matrix(150.0, 150.0, 64.0, 63.0), (128, 128)
    poses, wholes = [], []
    for number, part in enumerate(parts):
        rotation = Rotation.random(rng=rng).as_matrix()
        place = np.array([0.05 * number - 0.03, 0.005 * image, 0.4 - 0.06 * number])
        poses.append(make_transform(rotation, place))
        shown = SceneObject(make_surface(part.mesh), poses[-1], part=part)
        wholes.append(silhouette(shown, K, size).mask)
    seen = [wholes[0] & ~wholes[1], wholes[1]]
    instances = [
        Instance(part.name, T, project_keypoints(part.cuboid, T, K), mask.sum() / all_.sum(), mask)
        for part, T, mask, all_ in zip(parts, poses, seen, wholes, strict=True)
    ]
    pixels = rng.integers(0, 256, (128, 128, 3), np.uint8)
    return Sample(pixels, K, instances, np.full((128, 128), 0.4, np.float32))
