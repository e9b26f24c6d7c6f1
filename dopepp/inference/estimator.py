"""PoseEstimator: estimates poses from an image and its camera matrix, without Hydra or a config.

:class:`PoseEstimator` contains what all estimators share: refinement, verification and score, and
the interfaces for images, streams and several views. Subclasses detect the start poses:
:mod:`~dopepp.inference.network_estimator` by a network, and
:mod:`~dopepp.inference.template_estimator` by templates of a mesh.
"""

from __future__ import annotations

import copy
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, Self, Unpack

import numpy as np
import torch
from jaxtyping import Float

from dopepp.core.compiled import compile_in_background
from dopepp.core.errors import UserError
from dopepp.core.extensions import enable
from dopepp.core.pool import map_in_threads
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.inference import runtimes
from dopepp.inference.input_image import Coefficients, Depth, Distances, Region, prepare_image
from dopepp.inference.pose_result import STEPS
from dopepp.parts.part import Part
from dopepp.recovery.detection import PROBABLE, Detection, RecoveryOptions, recalibrate
from dopepp.recovery.reasons import Reason, refined_reason

if TYPE_CHECKING:
    from dopepp.geometry.camera_file import Camera
    from dopepp.inference.frames import SourceLike
    from dopepp.inference.network_estimator import NetworkEstimator
    from dopepp.inference.pose_result import PoseResult
    from dopepp.inference.refinement.refiner import Refine
    from dopepp.inference.several_views.views_result import ViewsResult
    from dopepp.inference.stream import StreamOptions
    from dopepp.inference.template_estimator import TemplateEstimator


class SeenMaps(NamedTuple):
    """Belief maps of an image in one size."""

    K: CameraMatrix  # of the network's input, pixels
    stride: int  # pixels of the input per cell of the maps
    belief: Float[torch.Tensor, "beliefs height width"]
    depths: list[tuple[float, float] | None] | None  # searched for each part; None: no search


class PoseEstimator(ABC):
    """Estimates the 6D poses of parts on RGB images of any size.

    :meth:`load` makes an estimator from a checkpoint, :meth:`from_mesh` from a mesh.

    Args:
        recovery: Thresholds, and the calibration of scores and covariances.
        device: Device of the computation.
        refine: Measurements that refine poses: ``region`` (the image), ``depth`` (the depth
            image passed to :meth:`predict`), or both, ``("region", "depth")``. None: no refinement.
        parts: Parts with the meshes that refinement uses.
        max_ms: Time limit for the refinement of an image, milliseconds. The best detections are
            refined first; detections beyond the limit keep their start pose.
        scale_error: Largest relative error of the parts' size or of the focal length (default:
            0.005). Differences up to this error do not change a certain distance. Choose a small
            value for a calibrated camera and a measured part.

    Raises:
        UserError: The refinement is unknown, or a part has no mesh.
    """

    def __init__(
        self,
        recovery: RecoveryOptions,
        device: torch.device,
        refine: Refine | None,
        parts: Sequence[Part],
        max_ms: float | None,
        scale_error: float | None,
    ) -> None:
        self.recovery, self.device = recovery, device
        self.max_ms, self.scale_error = max_ms, scale_error
        self._refine_by(refine, parts)

    def _refine_by(self, refine: Refine | None, parts: Sequence[Part]) -> None:
        """Set the refinement, and reset the measured times."""
        self.refine, self.refiner = refine, None
        if refine is not None:  # imported on demand, because its solvers are slow to import
            from dopepp.inference.refinement.refiner import Refiner

            limits = {} if self.scale_error is None else {"scale_error": self.scale_error}
            self.refiner = Refiner(refine, parts, **limits)
        for function in ("warm_up_pose", "warm_up_refinement"):
            compile_in_background(f"dopepp.inference.refinement.refiner:{function}")
        self.solid_parts = tuple(parts)
        """Parts with the meshes that refinement uses."""
        self.spent_ms = dict.fromkeys(STEPS, 0.0)
        """Total milliseconds by step of :data:`~dopepp.inference.pose_result.STEPS`."""

    @staticmethod
    def load(
        path: str | Path,
        device: str | torch.device = "cpu",
        refine: Refine | None = None,
        parts: Sequence[Part] | None = None,
        max_ms: float | None = None,
        scale_error: float | None = None,
        extensions: Sequence[str] = (),
    ) -> NetworkEstimator:
        """Load a checkpoint, or a network that ``dopepp export`` wrote.

        Args:
            path: Checkpoint, or exported network.
            device: Device that runs the network, e.g. ``cpu`` or ``cuda``.
            refine: ``region``, ``depth`` or both (default: no refinement).
            parts: The checkpoint's parts with other meshes (default: the meshes in the checkpoint).
            max_ms: Time limit for the refinement of an image, milliseconds (default: none).
            scale_error: Largest relative error of the parts' size or of the focal length (default:
                0.005).
            extensions: Packages whose classes the checkpoint may name
                (:mod:`dopepp.core.extensions`). They stay enabled in this process.

        Raises:
            UserError: The file is missing, has another format or is not safe to load, an optional
                dependency is missing, or the refinement is not possible.
        """
        from dopepp.inference.network_estimator import NetworkEstimator

        enable(extensions)
        chosen = check_device(device)
        loaded = runtimes.load(Path(path), chosen)
        return NetworkEstimator(*loaded, chosen, refine, parts, max_ms, scale_error)

    @staticmethod
    def from_mesh(
        mesh: str | Path,
        unit: str | None = None,
        working_distance: tuple[float, float] | None = None,
        tilt_deg: float = 180.0,
        name: str | None = None,
        symmetries: Literal["auto"] | None = "auto",
        refine: Refine = "region",
        max_ms: float | None = None,
        scale_error: float | None = None,
    ) -> TemplateEstimator:
        """Make an estimator of one part from its mesh alone, without training.

        Args:
            mesh: Mesh file, or name of a built-in part.
            unit: Unit of the file: mm, cm, m or inch (default: the unit that the format states,
                otherwise mm).
            working_distance: Nearest and farthest depth of the part, metres; required.
            tilt_deg: Largest angle between the part's z axis and the direction to the camera,
                degrees.
            name: Name of the part (default: the name of the file).
            symmetries: ``auto`` finds them on the mesh; None: the part has none.
            refine: ``region``, which also verifies the poses, or ``region`` and ``depth``.
            max_ms: Time limit for the refinement of an image, milliseconds (default: none).
            scale_error: Largest relative error of the part's size or of the focal length (default:
                0.001).

        Raises:
            UserError: The mesh or an option is invalid, or the working distance is missing.
        """
        from dopepp.inference.template_estimator import TemplateEstimator, load_solid_part

        part = load_solid_part(mesh, unit, name, symmetries)
        return TemplateEstimator.of_parts(
            [part], working_distance, tilt_deg, refine, max_ms, scale_error
        )

    def refining(self, refine: Refine | None, parts: Sequence[Part] | None = None) -> Self:
        """Return an estimator with the same detector and another refinement or other meshes."""
        refining = copy.copy(self)
        refining._refine_by(refine, parts or self.parts)
        return refining

    def with_own_times(self) -> Self:
        """Return an estimator with the same detector, and :attr:`spent_ms` of its own."""
        changed = copy.copy(self)
        changed.spent_ms = dict.fromkeys(STEPS, 0.0)
        return changed

    @property
    @abstractmethod
    def parts(self) -> Sequence[Part]:
        """Detected parts."""

    @abstractmethod
    def depth_range(self, name: str) -> tuple[float, float] | None:
        """Return the depths (nearest, farthest) that are searched by default, metres."""

    @property
    @abstractmethod
    def _detector(self) -> str:
        """Name and input of the detector of start poses."""

    @abstractmethod
    def start_detections(
        self,
        image: RGBImage,
        K: CameraMatrix,
        distances: Distances | None,
        roi: Region | None,
        reasons: list[Reason] | None = None,
    ) -> tuple[list[Detection], list[SeenMaps]]:
        """Return detections before refinement, best score first, and the maps that show them.

        A reason is appended to ``reasons`` for each part without a candidate, and for each rejected
        candidate. Then, without refinement, scores below :attr:`min_score` are rejected, too.
        """

    def __repr__(self) -> str:
        """Describe the detector, the parts with their depths, and the thresholds."""
        lines = [f"{type(self).__name__}({self._detector}, {self.device}, refine={self.refine})"]
        for part in self.parts:
            size = " × ".join(f"{1000 * side:.0f}" for side in np.ptp(part.cuboid, axis=0))
            depths = self.depth_range(part.name)
            where = f", at {depths[0]:.2g} – {depths[1]:.2g} m" if depths else ""
            lines.append(f"{part.name}: {size} mm{where}")
        limits = self.recovery
        lines.append(
            f"thresholds: peak {limits.peak_threshold:.3g}, "
            f"centroid {limits.centroid_threshold:.3g}, score {limits.min_score:.3g}, "
            f"refined score {limits.refined_min_score:.3g}"
        )
        return "\n  ".join(lines)

    def predict(
        self,
        image: RGBImage,
        K: CameraMatrix,
        distortion: Coefficients | None = None,
        depth: Depth | None = None,
        distances: Distances | None = None,
        roi: Region | None = None,
        cropped: bool = False,
    ) -> list[Detection]:
        """Detect the parts on an image; leave out detections with a score below :attr:`min_score`.

        The image is resized so that parts have the same size as in training
        (:mod:`dopepp.inference.network_input`).

        Args:
            image: RGB, uint8, any size.
            K: Camera matrix in pixels of this image.
            distortion: OpenCV distortion coefficients. The image is undistorted first, with the
                same K; pixels of the result refer to the undistorted image.
            depth: Metres along z, aligned to the image (and equally distorted), 0 or NaN where
                unknown; used if the estimator refines with depth.
            distances: Nearest and farthest depth of the parts, metres (default: distances in
                training). ``any``: all distances at which the network can detect a part. The
                network runs more often for a larger range.
            roi: Region to process: (x, y, width, height), pixels.
            cropped: Whether the image may be a crop, with the principal point anywhere. Otherwise
                an off-centre principal point is rejected, because K probably belongs to another
                image size.

        Returns:
            Detections, best score first, in metres and pixels of ``image``. A refined
            detection has the refined pose with its keypoints and covariance, and a score that
            belongs to refined poses. If refinement kept the network's pose, ``kept`` is the reason.

        Raises:
            UserError: The image is not RGB, K does not belong to it, the distortion fits no OpenCV
                lens model, or the depth is not aligned or not in metres.
        """
        candidates = self.candidates(image, K, distortion, depth, distances, roi, cropped)
        return self.split(candidates)[0]

    def candidates(
        self,
        image: RGBImage,
        K: CameraMatrix,
        distortion: Coefficients | None = None,
        depth: Depth | None = None,
        distances: Distances | None = None,
        roi: Region | None = None,
        cropped: bool = False,
    ) -> list[Detection]:
        """Return all detections regardless of their score, best first; see :meth:`predict`.

        Most candidates below :attr:`min_score` are false detections. With refinement, candidates
        with a network score below :data:`~dopepp.recovery.detection.CANDIDATE` are left out.
        """
        image, K, depth = prepare_image(image, K, distortion, depth, cropped)
        starts, _ = self.start_detections(image, K, distances, roi)
        return self.candidates_from(starts, image, K, depth)

    def candidates_from(
        self,
        starts: Sequence[Detection],
        image: RGBImage,
        K: CameraMatrix,
        depth: Depth | None = None,
    ) -> list[Detection]:
        """Return start detections after refinement, with scores of refined poses, best first."""
        if self.refiner is None:
            return list(starts)
        by_depth = depth is not None and self.refiner.uses_depth
        return self._recalibrated(self.refined(starts, image, K, depth), by_depth)

    def _recalibrated(self, refined: Sequence[Detection], by_depth: bool) -> list[Detection]:
        """Replace scores and covariances by those fitted for refined poses; see `recalibrate`."""
        return recalibrate(refined, self.recovery, by_depth)

    @property
    def min_score(self) -> float:
        """Minimum score of a detection: the checkpoint's threshold, or that of :meth:`reporting`.

        Verified poses have a separate threshold in the checkpoint.
        """
        is_verified = self.refiner is not None and self.refiner.verifies
        return self.recovery.refined_min_score if is_verified else self.recovery.min_score

    def reporting(self, min_score: float | None) -> Self:
        """Return an estimator with the same detector and another minimum score.

        Args:
            min_score: New :attr:`min_score`, in [0, 1]; None keeps the threshold.

        Raises:
            UserError: The score is out of range.
        """
        if min_score is None:
            return self
        checked = check("min_score", min_score, float, Range(0, 1))
        changed = copy.copy(self)
        changed.recovery = replace(self.recovery, min_score=checked, refined_min_score=checked)
        return changed

    def split(self, candidates: Sequence[Detection]) -> tuple[list[Detection], list[float]]:
        """Return the candidates with at least :attr:`min_score`, and the scores of the others."""
        passed = [candidate for candidate in candidates if candidate.score >= self.min_score]
        weaker = [candidate.score for candidate in candidates if candidate.score < self.min_score]
        return passed, weaker

    def refined(
        self,
        detections: Sequence[Detection],
        image: RGBImage,
        K: CameraMatrix,
        depth: Depth | None = None,
        followed: bool = False,
    ) -> list[Detection]:
        """Refine detections; without a refinement, return the detections unchanged.

        If a refined pose is improbable, the detection's ``alternative`` is refined too, and
        replaces the pose if it is probable. After the time limit ``max_ms``, the remaining poses
        are verified, but not refined.

        Args:
            detections: Detections of the estimator's parts, in the order of refinement.
            image: RGB, without distortion.
            K: Camera matrix, pixels.
            depth: Metres along z, aligned to the image, 0 or NaN where unknown.
            followed: Whether the parts were refined on the previous frame, as in tracking.

        Returns:
            The refined detections in the same order, with scores from before the refinement.
        """
        if self.refiner is None:
            return list(detections)
        start = time.perf_counter()
        with self.timed("refine"):
            refine = partial(self._refined, image, K, depth, followed, start)
            return map_in_threads(refine, detections)

    def _refined(
        self,
        image: RGBImage,
        K: CameraMatrix,
        depth: Depth | None,
        followed: bool,
        start: float,
        detection: Detection,
    ) -> Detection:
        """Refine a detection or, ``max_ms`` after ``start``, only verify its pose."""
        assert self.refiner is not None  # the caller has checked it
        if self.max_ms is not None and 1000 * (time.perf_counter() - start) > self.max_ms:
            start_pose = detection.T_cam_obj, detection.covariance
            unrefined = replace(
                detection, start=start_pose, kept=f"max_ms={self.max_ms:g} was spent"
            )
            return self.refiner.verified(unrefined, image, K)
        best = self.refiner(detection, image, K, depth, followed)
        if detection.alternative is not None and (best.probability or 0.0) < PROBABLE:
            other = self.refiner(detection.alternative, image, K, depth)
            best = other if (other.probability or 0.0) >= PROBABLE else best
        return replace(best, alternative=None)

    def stream(
        self,
        source: SourceLike,
        K: CameraMatrix | None = None,
        camera: Camera | Path | str | None = None,
        **options: Unpack[StreamOptions],
    ) -> Iterator[PoseResult]:
        """Detect the parts in every frame of a source; see :func:`dopepp.inference.stream.stream`.

        Args:
            source: Path (image, folder, video, ROS recording), glob pattern, camera number or URL.
            K: Camera matrix; may be omitted for a recording that has one, or if camera is given.
            camera: Camera or camera file, instead of K.
            **options: See :class:`~dopepp.inference.stream.StreamOptions`.
        """
        from dopepp.inference.stream import stream  # imports sources, drawing and the tracker

        return stream(self, source, K, camera, **options)

    def predict_views(
        self,
        images: Sequence[RGBImage],
        cameras: Sequence[Camera | CameraMatrix],
        T_world_cam: Sequence[Transform],
        depths: Sequence[Depth] | None = None,
        distances: Distances | None = None,
        camera_error: tuple[float, float] | None = None,
        names: Sequence[str] | None = None,
    ) -> ViewsResult:
        """Estimate poses in the world from several images of a static scene.

        Args:
            images: RGB, uint8, of any sizes.
            cameras: Camera of each image, or its K in pixels of an undistorted image.
            T_world_cam: Pose of each camera in a common world frame, metres. The world may be any
                frame in which the scene is static.
            depths: Depth of each image; see :meth:`predict`.
            distances: See :meth:`predict`.
            camera_error: Standard deviations of each camera's pose: position along each axis
                (metres) and rotation about each axis (radians). The default, 0.2 mm and 0.02°, is
                typical after a hand-eye calibration.
            names: Name of each image, used in reported contradictions and as file name (default:
                ``view 0``, …).

        Returns:
            Parts with their poses and covariances in the world and their visibility in each view,
            and contradictions between the views.

        Raises:
            UserError: The estimator was loaded without refinement by region, an argument is
                invalid, or the numbers of images, cameras and poses differ.
        """
        from dopepp.inference.several_views import joint_estimator, search

        given = images, cameras, T_world_cam, depths, camera_error, names
        return search(self, joint_estimator(self, *given), distances)

    def explain(
        self,
        image: RGBImage,
        K: CameraMatrix,
        depth: Depth | None = None,
        distances: Distances | None = None,
        roi: Region | None = None,
        cropped: bool = False,
    ) -> list[Reason]:
        """Explain why :meth:`predict` detects no part, or no further part, on an image.

        Arguments and errors are as in :meth:`predict`; the image has no distortion.

        Returns:
            A reason for each part without a candidate, and for each rejected candidate.
        """
        image, K, depth = prepare_image(image, K, None, depth, cropped)
        reasons: list[Reason] = []
        starts, _ = self.start_detections(image, K, distances, roi, reasons)
        candidates = self.candidates_from(starts, image, K, depth)
        rejected = [candidate for candidate in candidates if candidate.score < self.min_score]
        return reasons + [refined_reason(candidate, self.min_score) for candidate in rejected]

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Add the block's time to that of a step, including its pending work on a GPU."""
        start = time.perf_counter()
        yield
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self.spent_ms[step] += 1000 * (time.perf_counter() - start)


def check_device(device: str | torch.device) -> torch.device:
    """Return a device after a test allocation on it.

    Raises:
        UserError: The device does not exist or does not work.
    """
    try:
        chosen = torch.device(device)
        torch.zeros(1, device=chosen).item()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        allowed = "cpu or cuda" if torch.cuda.is_available() else "cpu (this PyTorch has no cuda)"
        reason = str(error).partition("\n")[0]
        problem = f"device {device} ({reason:.100})"
        raise UserError(problem, allowed, "choose a device of this machine, e.g. cpu") from error
    return chosen
