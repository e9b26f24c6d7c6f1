from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io

from dopepp.data.sample import Instance, Sample, SourceInfo
from dopepp.geometry.camera import camera_matrix, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.part import Part

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
        T = np.eye(4)
        T[:3, 3] = rng.uniform(-0.02, 0.02, 3) + np.array([0, 0, 0.25])
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
    """Writes a tiny YCB-Video folder; frames can be spoilt afterwards."""

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
            T = np.eye(4)
            T[:3, 3] = (0.04 * i, 0.0, 0.3)
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


@pytest.fixture(scope="session")
def contents():
    """Read every file of a folder, and every folder as an empty one."""

    def read(root):
        return {
            str(path.relative_to(root)): path.read_bytes() if path.is_file() else b""
            for path in root.rglob("*")
        }

    return read
