"""PoseEstimator: one file in, poses out; needs neither Hydra nor any config."""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import cv2
import numpy as np
import torch
from jaxtyping import Float

from dopepp.core.compiled import compile_beside
from dopepp.core.errors import UserError
from dopepp.core.extensions import enable
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix, Letterbox, project_keypoints
from dopepp.inference import runtimes
from dopepp.inference.picture import (
    Coefficients,
    Depth,
    Distances,
    Region,
    checked_depth,
    checked_distortion,
    checked_picture,
    cut,
    letterboxed,
    letterboxes,
    merged,
    undistorted_depth,
)
from dopepp.inference.results import STEPS
from dopepp.inference.runtimes.runtime import Runtime
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection
from dopepp.recovery.recover import Reason, explain, recover, rejected_refined
from dopepp.recovery.scoring import RecoveryOptions, rescored

if TYPE_CHECKING:
    from dopepp.geometry.camera_file import Camera
    from dopepp.inference.refinement.refiner import Refine
    from dopepp.inference.results import PoseResult
    from dopepp.inference.sources import SourceLike
    from dopepp.inference.stream import StreamOptions

Maps = tuple[
    Float[torch.Tensor, "beliefs height width"], Float[torch.Tensor, "fields height width"]
]


class PoseEstimator:
    """Finds the 6D poses of the trained parts on RGB images of any size.

    Args:
        network: The trained network, of PyTorch's or out of an exported file.
        checkpoint: What the network was trained for.
        device: Where to run it, e.g. ``cpu`` or ``cuda``.
        refine: What refines poses (:mod:`dopepp.inference.refinement.refiner`): ``region``, the
            picture; ``depth``, the depth that :meth:`predict` is given; or both, ``("region",
            "depth")``. None does not.
        parts: The checkpoint's parts with other meshes, or with some where it has none.
        max_ms: Milliseconds of refining a picture after which its further detections, the best
            score first, keep the network's poses; None sets no limit.

    Raises:
        UserError: The refinement is unknown, or a part has no mesh.
    """

    def __init__(
        self,
        network: Runtime,
        checkpoint: Checkpoint,
        device: str | torch.device = "cpu",
        refine: Refine | None = None,
        parts: Sequence[Part] | None = None,
        max_ms: float | None = None,
    ) -> None:
        self.checkpoint = checkpoint
        self.refine, self.refiner = refine, None
        if refine is not None:  # its solvers take as long to import as all else but torch
            from dopepp.inference.refinement.refiner import Refiner

            self.refiner = Refiner(refine, parts or checkpoint.parts)
        self.max_ms = max_ms
        for function in ("rehearse_pose", "rehearse_refinement"):
            compile_beside(f"dopepp.inference.refinement.refiner:{function}")
        self.device = checked_device(device)
        self.solid_parts = tuple(parts or checkpoint.parts)
        """Its parts, with the meshes that it was given."""
        self.spent_ms = dict.fromkeys(STEPS, 0.0)
        """Milliseconds since it was made, by step of :data:`~dopepp.inference.results.STEPS`."""
        self.network = runtimes.placed(network, self.device)
        self.cuboids = np.stack([part.cuboid for part in checkpoint.parts])
        self._names = [part.name for part in checkpoint.parts]
        self._cuboid_of = dict(zip(self._names, self.cuboids, strict=True))
        self.recovery = RecoveryOptions.of({"sigma": checkpoint.sigma, **checkpoint.recovery})

    @classmethod
    def load(
        cls,
        path: str | Path,
        device: str | torch.device = "cpu",
        refine: Refine | None = None,
        parts: Sequence[Part] | None = None,
        max_ms: float | None = None,
        extensions: Sequence[str] = (),
    ) -> PoseEstimator:
        """Load a checkpoint, or what ``dopepp export`` made of one; see the class for the options.

        ``extensions`` are packages of your own whose classes a checkpoint may name
        (:mod:`dopepp.core.extensions`); they stay enabled in this process.

        A :class:`UserError`: the file is missing, is neither of these or not safe to load, its
        extra is missing, or the refinement is not possible.
        """
        enable(extensions)
        chosen = checked_device(device)
        return cls(*runtimes.load(Path(path), chosen), chosen, refine, parts, max_ms)

    def refining(self, refine: Refine, parts: Sequence[Part] | None = None) -> PoseEstimator:
        """Return an estimator with the same network that also refines; see the class."""
        return type(self)(self.network, self.checkpoint, self.device, refine, parts, self.max_ms)

    @property
    def parts(self) -> Sequence[Part]:
        """The objects this estimator knows, in the network's order."""
        return self.checkpoint.parts

    def __repr__(self) -> str:
        """Say what it finds at which distances, with which network and thresholds."""
        known, limits = self.checkpoint, self.recovery
        runtime = type(self.network).__name__
        width, height = known.input_size
        name = known.data.get("name", "network")
        lines = [f"PoseEstimator({name} as {runtime}, {width}×{height} pixels, "
                 f"{self.device}, refine={self.refine})"]  # fmt: skip
        for part in self.parts:
            size = " × ".join(f"{1000 * one:.0f}" for one in np.ptp(part.cuboid, axis=0))
            seen = known.seen.get(part.name)
            where = f", learned at {seen.nearest:.2g} – {seen.farthest:.2g} m" if seen else ""
            lines.append(f"{part.name}: {size} mm{where}")
        lines.append(
            f"thresholds: peak {limits.peak_threshold:.3g}, "
            f"centroid {limits.centroid_threshold:.3g}, score {limits.min_score:.3g}, "
            f"refined score {limits.refined_min_score:.3g}"
        )
        return "\n  ".join(lines)

    def predict(
        self,
        image: Picture,
        K: CameraMatrix,
        distortion: Coefficients | None = None,
        depth: Depth | None = None,
        distances: Distances | None = None,
        roi: Region | None = None,
        cropped: bool = False,
    ) -> list[Detection]:
        """Find all known objects on one image.

        The image is resized until parts have the size that they had in training
        (:mod:`dopepp.inference.picture`).

        Args:
            image: RGB, uint8, any size.
            K: Camera matrix in pixels of this image.
            distortion: OpenCV distortion coefficients; the image is undistorted first, with the
                same K, and pixels of the result refer to the undistorted image.
            depth: Metres along z, aligned to the image (and distorted as it is), 0 or NaN where
                unknown; used where the estimator refines with depth.
            distances: Nearest and farthest depth at which parts are looked for, metres; None is
                where training had them, ``any`` wherever the network can see them. The farther
                apart, the more often it looks.
            roi: Look in this part of the image only: (x, y, width, height), pixels.
            cropped: The image may be cut out of the camera's, so that the principal point may lie
                anywhere; elsewhere a K that is off the middle is taken for another size's.

        Returns:
            Detections, best score first, in pixels of the given size and metres. A refined one has
            the refined pose, its keypoints and covariance, and the score that tuning has fitted to
            refined poses; all else stays the network's. Where refinement kept the network's pose,
            ``kept`` says why.

        Raises:
            UserError: The image is no RGB picture, K cannot belong to it, there is no lens model
                with so many coefficients, or the depth is not aligned or not in metres.
        """
        image, K = checked_picture(image, K, cropped)
        if depth is not None:
            depth = checked_depth(depth, (image.shape[1], image.shape[0]))
        if distortion is not None:
            coefficients = checked_distortion(distortion)
            image = cv2.undistort(image, K, coefficients)
            depth = None if depth is None else undistorted_depth(depth, K, coefficients)
        detections = self._detect(image, K, distances, roi)
        if self.refiner is None:
            return detections
        return rescored(self.refined(detections, image, K, depth), self.recovery)

    def refined(
        self,
        detections: Sequence[Detection],
        image: Picture,
        K: CameraMatrix,
        depth: Depth | None = None,
    ) -> list[Detection]:
        """Refine detections, whoever made them, where the estimator refines at all.

        Image, K and depth are as in :meth:`predict`, checked and without distortion.
        """
        if self.refiner is None:
            return list(detections)
        refined: list[Detection] = []
        start = time.perf_counter()
        with self._timed("refine"):
            for one in detections:
                if self.max_ms is not None and 1000 * (time.perf_counter() - start) > self.max_ms:
                    refined.append(replace(one, kept=f"max_ms={self.max_ms:g} was spent"))
                    continue
                result = self.refiner(one, image, K, depth)
                if result.covariance is None:
                    refined.append(replace(one, kept=result.reason, agreement=None, support=None))
                    continue
                T = result.T_cam_obj
                keypoints = project_keypoints(self._cuboid_of[one.object], T, K)
                refined.append(
                    replace(
                        one, T_cam_obj=T, keypoints=keypoints, covariance=result.covariance,
                        kept="", agreement=result.agreement, support=result.support,
                    )
                )  # fmt: skip
        return refined

    def stream(
        self,
        source: SourceLike,
        K: CameraMatrix | None = None,
        camera: Camera | Path | str | None = None,
        **options: Unpack[StreamOptions],
    ) -> Iterator[PoseResult]:
        """Find the parts on every picture of a source; see :func:`dopepp.inference.stream.stream`.

        The source is a path (a picture, a folder, a video, a ROS bag), a glob pattern, a camera's
        number or a stream's URL. K, the camera or its file may be left out where a bag has it.
        """
        from dopepp.inference.stream import stream  # which needs sources, drawing and a tracker

        return stream(self, source, K, camera, **options)

    def explain(
        self,
        image: Picture,
        K: CameraMatrix,
        depth: Depth | None = None,
        distances: Distances | None = None,
        roi: Region | None = None,
        cropped: bool = False,
    ) -> list[Reason]:
        """Say what :meth:`predict` leaves out of an image and why, for each object or centroid.

        The image is without distortion. What :meth:`predict` refuses is a :class:`UserError`.
        """
        image, K = checked_picture(image, K, cropped)
        window, K_window, _ = cut(image, K, roi)
        reasons: list[Reason] = []
        for box in letterboxes(self.checkpoint, K_window, window, distances):
            belief, field = self._look(window, box)
            reasons += explain(
                belief, field, self.cuboids, box.camera(K_window), self.network.stride,
                self._names, **self._recovery_options(),
            )  # fmt: skip
        least = self.recovery.refined_min_score
        if self.refiner is None or least == 0:
            return reasons
        lenient = copy.copy(self)
        lenient.recovery = replace(self.recovery, refined_min_score=0.0)
        judged = lenient.predict(image, K, None, depth, distances, roi, cropped)
        return reasons + [rejected_refined(one, least) for one in judged if one.score < least]

    def _detect(
        self,
        image: Picture,
        K: CameraMatrix,
        distances: Distances | None,
        roi: Region | None,
    ) -> list[Detection]:
        """Return the network's detections, in the image's pixels."""
        window, K_window, corner = cut(image, K, roi)
        scales: list[list[Detection]] = []
        for box in letterboxes(self.checkpoint, K_window, window, distances):
            belief, field = self._look(window, box)
            with self._timed("decode"):
                found = recover(
                    belief, field, self.cuboids, box.camera(K_window), self.network.stride,
                    self._names, **self._recovery_options(),
                )  # fmt: skip
            scales.append([self._in_original(one, box, corner, K) for one in found])
        return merged(scales)

    def _look(self, window: Picture, box: Letterbox) -> Maps:
        """Run the network on a window in one of its sizes."""
        with self._timed("pre"):
            pixels = letterboxed(window, box, self.network.size_multiple)
        with self._timed("network"):
            return self.maps(pixels)

    def _recovery_options(self) -> dict[str, float]:
        """Return the thresholds; candidates for refinement pass lower ones."""
        return vars(self.recovery if self.refiner is None else self.recovery.of_candidates())

    def _in_original(
        self, detection: Detection, box: Letterbox, corner: tuple[int, int], K: CameraMatrix
    ) -> Detection:
        """Express a detection's pixels in the original image; the pose is the same in both."""
        cuboid = self._cuboid_of[detection.object]
        return replace(
            detection,
            keypoints=project_keypoints(cuboid, detection.T_cam_obj, K),
            peaks=box.original_points(detection.peaks) + np.array(corner),
            reprojection_error_px=detection.reprojection_error_px / box.scale_x,
        )

    @contextmanager
    def _timed(self, step: str) -> Iterator[None]:
        """Count what a step takes, with what it has left to a GPU to do."""
        start = time.perf_counter()
        yield
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self.spent_ms[step] += 1000 * (time.perf_counter() - start)

    def maps(self, image: Picture) -> Maps:
        """Run the network on one image whose sides are multiples of its size multiple."""
        pixels = torch.from_numpy(image).to(self.device).permute(2, 0, 1)[None]
        with torch.inference_mode():
            belief, field = self.network.maps(pixels)
        return belief[0].float(), field[0].float()


def checked_device(device: str | torch.device) -> torch.device:
    """Return a device that can compute; a :class:`UserError` where there is none of this name."""
    try:
        chosen = torch.device(device)
        torch.zeros(1, device=chosen).item()  # asks the driver
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        there = "cpu or cuda" if torch.cuda.is_available() else "cpu (this PyTorch has no cuda)"
        reason = str(error).partition("\n")[0]
        raise UserError(f"device {device} ({reason:.100})", there, "pass one of these") from error
    return chosen
