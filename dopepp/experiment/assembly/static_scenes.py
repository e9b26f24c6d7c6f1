"""Test images of static scenes, each with further images of its scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_reader import BopReader
from dopepp.data.sample import Sample, SampleSource
from dopepp.geometry.camera import Transform
from dopepp.inference.several_views.view_files import CameraPoses, read_camera_poses

ANGLE_DEG: Final = 25.0  # preferred angle between the optical axes of chosen cameras, degrees


class StaticScenes:
    """Images of a BOP split, a folder per static scene, each with further images of its scene."""

    def __init__(self, reader: BopReader, num_views: int) -> None:
        self._reader, self._num_others, self.name = reader, num_views - 1, reader.name
        self._scenes: dict[str, list[int]] = {}
        self._T_world_cam: list[Transform] = []
        poses: dict[str, CameraPoses] = {}
        for index, (scene, image) in enumerate(reader.image_ids):
            if scene not in poses:
                folder = reader.root / reader.split / scene
                poses[scene] = read_camera_poses(folder / "scene_camera.json")
            self._T_world_cam.append(poses[scene].poses[f"{image}"].T_world_cam)
            self._scenes.setdefault(scene, []).append(index)
        scene, indices = min(self._scenes.items(), key=lambda item: len(item[1]))
        if len(indices) < num_views:
            problem = f"data.views={num_views} with {len(indices)} test images of scene {scene}"
            allowed = f"at least {num_views} images of every static scene"
            raise UserError(problem, allowed, "set data.views to a smaller number")

    def __len__(self) -> int:
        return len(self._reader)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Read an image and further images of its scene (``others``), each with its camera pose."""
        first, *others = (
            replace(self._reader.sample(number), T_world_cam=self._T_world_cam[number])
            for number in [index, *self._further_views(index)]
        )
        return replace(first, others=others)

    def _further_views(self, index: int) -> Sequence[int]:
        """Choose images of the same scene, each about 25° from its nearest chosen camera."""
        scene = self._reader.image_ids[index][0]
        left, chosen = [number for number in self._scenes[scene] if number != index], [index]
        axes = {number: self._T_world_cam[number][:3, 2] for number in self._scenes[scene]}
        for _ in range(self._num_others):
            cosines = np.array([[axes[a] @ axes[b] for b in chosen] for a in left])
            # Angle of each remaining camera to the nearest camera chosen before.
            angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).min(axis=1)
            chosen.append(left.pop(int(np.abs(angles - ANGLE_DEG).argmin())))
        return chosen[1:]


def with_views(source: SampleSource, num_views: int) -> SampleSource:
    """Return test images with further images of their scenes."""
    if isinstance(source, BopReader):
        return StaticScenes(source, num_views)
    raise UserError(
        f"data.views={num_views} with {source.name}",
        "a BOP data set whose scene_camera.json holds camera poses",
        f"render one with `dopepp render … --views {num_views}`, and set data=bop data.root=FOLDER",
    )
