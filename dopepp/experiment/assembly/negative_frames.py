"""Build camera frames without the objects, which tune and test the detection threshold.

The frames have the full size of the camera and are of several kinds in turn (:data:`KINDS`). The
kind of a frame is its sample's ``source``. Frames of the validation and the test split show
different photos.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final, Literal

import numpy as np

from dopepp.data.negatives import FrameMix, PhotoFrames
from dopepp.data.rendered import RenderedSource
from dopepp.data.sample import SampleSource
from dopepp.drawing.pictures import Size
from dopepp.experiment.assembly.build_parts import build_negatives
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.assembly.photos import held_out_photos, negative_photos
from dopepp.experiment.config.data_config import DataConfig
from dopepp.geometry.camera import crop_camera
from dopepp.geometry.cuboid import CENTROID
from dopepp.parts.lookalikes import lookalikes
from dopepp.parts.part import Parts
from dopepp.virtual.backgrounds import PhotoBackgrounds, find_backgrounds
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import Preset
from dopepp.virtual.presets.placement import DistancePlacement
from dopepp.virtual.presets.view import View

PHOTOS: Final = "photos"
SCENES: Final = "scenes"
LOOKALIKES: Final = "look-alikes"
OWN: Final = "own images"
KINDS: Final = {
    PHOTOS: "photos, whole",
    SCENES: "renders of clutter, distractors and other parts",
    LOOKALIKES: "renders of look-alikes of the parts in front of photos",
    OWN: "the user's own images without the parts",
}
"""Content of each kind of frame, in the order of the frames.

A threshold that rejects look-alikes would reject the part as well, so tables show look-alikes in a
separate row."""

FRAME: Final[Size] = (640, 480)
"""(width, height), pixels, of frames without a camera if the preset's images are smaller."""

_MAX_DISTRACTORS: Final = 12  # per frame; limits the rendering time
_LOOKALIKES_SHOWN: Final = (1, 3)  # smallest and largest number per frame
_MARGIN: Final = 0.3  # border without look-alikes, share of the frame, if there is no camera
_NUM_LABELLED: Final = 20  # number of labelled images whose distances are measured
_NUM_POSES: Final = 64  # number of sampled poses per part for measuring the preset's distances


def negative_frames(
    data: DataConfig, parts: Parts, split: Literal["val", "test"], num_images: int
) -> SampleSource:
    """Build frames of a held-out split that show none of the parts, which have meshes.

    Raises:
        UserError: A folder of photos has too few photos to be divided.
    """
    view, preset = frame_view(data, parts), data.preset
    photos, user_photos = held_out_photos(data, split), negative_photos(data, split)
    dense = _as_dense(preset, view.size) if data.virtual.view is None else preset
    preset = view.whole(dense, data.virtual.camera_scale or 1.0)
    if data.virtual.view is None:
        # Far from the centre, the short focal length distorts parts more than in the preset.
        near, far = view.distance
        preset = replace(preset, placement=DistancePlacement(near, far, _MARGIN))
    if preset.table is not None:  # without physics, which look-alikes do not need
        preset = replace(preset, table=replace(preset.table, pile=None))
    share = math.ceil(num_images / (3 if user_photos is None else 4))

    def whole(images: PhotoBackgrounds, kind: str) -> PhotoFrames:
        return PhotoFrames(images, view.K, view.size, share, kind, data.eval_seed)

    empty = replace(preset, targets_per_image=(0, 0))
    bare = replace(
        preset,
        targets_per_image=_LOOKALIKES_SHOWN,
        distractors=replace(preset.distractors, number=(0, 0)),
        clutter=(0, 0),
        background_contrast=(1.0, 1.0),
    )
    behind = find_backgrounds(data.virtual.backgrounds, split)
    # Frames always use the fast renderer.
    scenes = Factory(parts, empty, data.eval_seed, behind, negatives=build_negatives(data, parts))
    similar = Factory(lookalikes(parts), bare, data.eval_seed, photos)
    sources: list[SampleSource] = [
        whole(photos, PHOTOS),
        RenderedSource(scenes, share, split, SCENES),
        RenderedSource(similar, share, split, LOOKALIKES),
    ]
    if user_photos is not None:
        sources.append(whole(user_photos, OWN))
    return FrameMix(sources, num_images)


def frame_view(data: DataConfig, parts: Parts) -> View:
    """Return the camera of :func:`negative_frames` and the range of distances of the parts.

    The camera is ``virtual.camera`` if set, or that of the labelled validation images. Otherwise
    the camera has the preset's focal length and images of at least :data:`FRAME` pixels.
    """
    if data.virtual.view is not None:
        return data.virtual.view
    if not data.is_rendered("val") and (labelled := _labelled_view(data, parts)) is not None:
        return labelled
    preset = data.preset
    width, height = max(preset.width, FRAME[0]), max(preset.height, FRAME[1])
    K = crop_camera(preset.K, (preset.width - width) / 2, (preset.height - height) / 2)
    near, far = _distances(preset, parts)
    return View((width, height), K, (max(near, 0.02), max(far, 0.02)))


def _labelled_view(data: DataConfig, parts: Parts) -> View | None:
    """Return the camera and the depths of the parts in the first labelled validation images."""
    source = held_out_source(data, parts, "val")
    samples = [source.sample(index) for index in range(min(len(source), _NUM_LABELLED))]
    poses = [instance.T_cam_obj for sample in samples for instance in sample.instances]
    depths = [max(float(pose[2, 3]), 0.02) for pose in poses]
    return View(samples[0].size, samples[0].K, (min(depths), max(depths))) if depths else None


def _distances(preset: Preset, parts: Parts) -> tuple[float, float]:
    """Return the range of depths at which a preset places the middle of a part, metres."""
    if preset.table is not None:
        return preset.table.distance
    rng, depths = np.random.default_rng(0), []
    for part in parts:
        for _ in range(_NUM_POSES):
            points = (part.points - part.cuboid[CENTROID]) @ preset.turning.draw(rng).T
            size = preset.width, preset.height
            depth = float(preset.placement.draw(rng, preset.K, size, points)[2])
            depths.append(depth + float(points[:, 2].min() + points[:, 2].max()) / 2)
    return min(depths), max(depths)


def _as_dense(preset: Preset, size: Size) -> Preset:
    """Return a preset whose distractors keep their pixel size and density in frames of ``size``."""
    old, scale = preset.distractors, size[0] / preset.width
    growth = size[0] * size[1] / (preset.width * preset.height)
    low, high = (min(math.ceil(count * growth), _MAX_DISTRACTORS) for count in old.number)
    share = old.image_share[0] / scale, old.image_share[1] / scale
    return replace(preset, distractors=replace(old, number=(low, high), image_share=share))
