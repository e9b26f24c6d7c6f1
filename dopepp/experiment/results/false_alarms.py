"""Count false detections of estimators on images that show none of their parts.

The user provides the images, and the camera file if the camera is not that of the test data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from dopepp.data.negatives import PhotoFrames
from dopepp.data.sample import Sample, SampleSource
from dopepp.drawing.overlay import YELLOW, Wireframe, overlay
from dopepp.drawing.pictures import Size, read_picture
from dopepp.drawing.sheet import Tile
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.assembly.negative_frames import frame_view
from dopepp.experiment.config.data_config import DataConfig
from dopepp.experiment.results.frame import Row
from dopepp.experiment.results.report import Report
from dopepp.geometry.camera_file import Camera, read_camera
from dopepp.inference.estimator import PoseEstimator
from dopepp.metrics.row import NOT_AVAILABLE
from dopepp.parts.part import Parts
from dopepp.virtual.backgrounds import PhotoBackgrounds

TITLE: Final = "Images without the part"
KEY: Final = "without_part"  # key of `Report.details`: a `FalseAlarms` as a dictionary

NUM_HIGHEST: Final = 6  # number of highest-scoring images to name and to draw


@dataclass(frozen=True)
class FalseAlarms:
    """Detections of an estimator on images without its parts."""

    num_images: int
    per_image: float  # reported detections
    threshold: float  # minimum score of a reported detection
    highest: dict[str, float]  # highest-scoring images, with their best candidate's score

    def row(self, method: str) -> Row:
        """Return the texts of a method's table row, by heading."""
        best = next(iter(self.highest.values()), None)
        return {
            "method": method,
            "images": f"{self.num_images:,}",
            "detections per image": f"{self.per_image:.3f}",
            "threshold": f"{self.threshold:.3g}",
            "highest score": NOT_AVAILABLE if best is None else f"{best:.3g}",
            "highest-scoring images": ", ".join(self.highest),
        }


class UndistortedFrames(PhotoFrames):
    """Images of a camera, without its lens distortion."""

    def __init__(self, images: PhotoBackgrounds, camera: Camera, size: Size) -> None:
        super().__init__(images, camera.K, size)
        self._camera = camera

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return an undistorted image without instances, with the path of its file as key."""
        sample = super().sample(index, epoch)
        key = sample.key.rpartition("/")[0]
        return replace(sample, image=self._camera.undistorted(sample.image), key=key)


def frames_without_parts(
    folder: Path, camera: Path | None, data: DataConfig, parts: Parts
) -> UndistortedFrames:
    """Open a folder of photos, searched recursively, that show none of the parts.

    Images are scaled and cropped to ``camera``, or to the camera of the test data.
    """
    images = PhotoBackgrounds(folder)
    lens = _camera_of(data, parts) if camera is None else read_camera(camera)
    size = lens.size
    if size is None:
        height, width = read_picture(images.paths[0]).shape[:2]
        size = (width, height)
    return UndistortedFrames(images, lens, size)


def _camera_of(data: DataConfig, parts: Parts) -> Camera:
    """Return the camera of the test data; of its first image, if the images are labelled."""
    if data.is_rendered("test"):
        view = frame_view(data, parts)
        size, K = view.size, view.K
    else:
        first = held_out_source(data, parts, "test").sample(0)
        size, K = first.size, first.K
    return Camera(size, K, (), "the camera of the test data")


def count_false_alarms(
    estimators: Mapping[str, PoseEstimator], frames: SampleSource
) -> tuple[dict[str, FalseAlarms], list[Tile]]:
    """Count the detections of estimators on images without their parts.

    Also return tiles of the last estimator's images with the highest scores.
    """
    alarms, tiles = {}, []
    for name, estimator in estimators.items():
        num_reported = 0
        scored: list[tuple[float, int]] = []
        for index in range(len(frames)):
            sample = frames.sample(index)
            candidates = estimator.candidates(sample.image, sample.K, cropped=True)
            num_reported += len(estimator.split(candidates)[0])
            scored += [(candidates[0].score, index)] if candidates else []
        scored.sort(key=lambda pair: (-pair[0], pair[1]))
        highest = [(frames.sample(index), score) for score, index in scored[:NUM_HIGHEST]]
        scores = {sample.key: score for sample, score in highest}
        rate = num_reported / len(frames)
        alarms[name] = FalseAlarms(len(frames), rate, estimator.min_score, scores)
        tiles = [_tile(estimator, sample) for sample, _ in highest]
    return alarms, tiles


def _tile(estimator: PoseEstimator, sample: Sample) -> Tile:
    best = estimator.candidates(sample.image, sample.K, cropped=True)[0]
    wireframe = Wireframe(best.keypoints, YELLOW, f"{best.object} {best.score:.3g}")
    return Tile(overlay(sample.image, [wireframe]), sample.key)


def alarm_rows(report: Report) -> list[Row]:
    """Return the table rows of a method and its refined poses, if false detections were counted."""
    reports = [report] if report.refined is None else [report, report.refined]
    return [
        FalseAlarms(**each.details[KEY]).row(each.name) for each in reports if KEY in each.details
    ]
