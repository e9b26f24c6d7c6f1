"""Estimator whose start poses come from a trained network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Unpack

import numpy as np
import torch
from jaxtyping import Float

from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix
from dopepp.inference import runtimes
from dopepp.inference.estimator import PoseEstimator, SeenMaps, check_device
from dopepp.inference.input_image import Distances, Region
from dopepp.inference.network_input import NetworkView, merge_scales, network_views
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.part import Part
from dopepp.recovery.detection import CANDIDATE, PROBABLE, Detection, RecoveryOptions
from dopepp.recovery.reasons import Reason, format_reasons
from dopepp.recovery.recover import recover_batch

if TYPE_CHECKING:
    from dopepp.geometry.camera_file import Camera
    from dopepp.inference.pose_result import PoseResult
    from dopepp.inference.refinement.refiner import Refine
    from dopepp.inference.stream import StreamOptions

Maps = tuple[
    Float[torch.Tensor, "beliefs height width"], Float[torch.Tensor, "fields height width"]
]


class NetworkEstimator(PoseEstimator):
    """Estimates the poses of the trained parts.

    Args:
        network: Trained PyTorch network, or exported network.
        checkpoint: Parts, input size and thresholds of the network.
        device: Device that runs the network, e.g. ``cpu`` or ``cuda``.
        refine: See :class:`PoseEstimator` (default: no refinement).
        parts: The checkpoint's parts with other meshes (default: the meshes in the checkpoint).
        max_ms: See :class:`PoseEstimator`.
        scale_error: See :class:`PoseEstimator`.

    Raises:
        UserError: The refinement is unknown, or a part has no mesh.
    """

    def __init__(
        self,
        network: runtimes.Runtime,
        checkpoint: Checkpoint,
        device: str | torch.device = "cpu",
        refine: Refine | None = None,
        parts: Sequence[Part] | None = None,
        max_ms: float | None = None,
        scale_error: float | None = None,
    ) -> None:
        recovery = RecoveryOptions.of({"sigma": checkpoint.sigma, **checkpoint.recovery})
        self.checkpoint, chosen = checkpoint, check_device(device)
        super().__init__(recovery, chosen, refine, parts or checkpoint.parts, max_ms, scale_error)
        self.network = runtimes.move_to_device(network, chosen)
        self.cuboids = np.stack([part.cuboid for part in checkpoint.parts])
        self._names = [part.name for part in checkpoint.parts]
        self._cuboid_of = dict(zip(self._names, self.cuboids, strict=True))

    @property
    def parts(self) -> Sequence[Part]:
        """Detected parts, in the order of the network's outputs."""
        return self.checkpoint.parts

    def depth_range(self, name: str) -> tuple[float, float] | None:
        """Return the depths (nearest, farthest) that are searched by default, metres.

        For a network, this is the training range; None if the checkpoint does not record it.
        """
        seen = self.checkpoint.seen.get(name)
        return None if seen is None else (seen.nearest, seen.farthest)

    @property
    def _detector(self) -> str:
        """Name, runtime and input size of the network."""
        runtime, name = type(self.network).__name__, self.checkpoint.data.get("name", "network")
        width, height = self.checkpoint.input_size
        return f"{name} as {runtime}, {width}×{height} pixels"

    def start_detections(
        self,
        image: RGBImage,
        K: CameraMatrix,
        distances: Distances | None,
        roi: Region | None,
        reasons: list[Reason] | None = None,
    ) -> tuple[list[Detection], list[SeenMaps]]:
        """Return detections before refinement, best score first, and the maps that show them."""
        with self.timed("pre"):
            views = self.views(image, K, distances, roi)
        # With refinement, the threshold is lower.
        threshold = 0.0 if reasons is None else self.min_score
        threshold = threshold if self.refiner is None else CANDIDATE
        stride, options = self.network.stride, vars(replace(self.recovery, min_score=threshold))
        scales, seen = list[list[Detection]](), list[SeenMaps]()
        for view in views:
            # A second view hardly improves a probable detection, and doubles the time.
            if view.is_further and self._detects_all_parts(scales):
                continue
            with self.timed("pre"):
                pixels = view.pixels
            with self.timed("network"):
                belief, field = self.maps(pixels)
            with self.timed("decode"):
                depths = self._searched_depths(view)
                (detections,) = recover_batch(
                    belief[None], field[None], self.cuboids, view.K[None], stride, self._names,
                    reasons, depths, **options,
                )  # fmt: skip
            scales.append(
                [view.to_image(item, self._cuboid_of[item.object], K) for item in detections]
            )
            seen.append(SeenMaps(view.K, stride, belief, depths))
        return merge_scales(scales), seen

    def _detects_all_parts(self, scales: Sequence[Sequence[Detection]]) -> bool:
        """Return whether each part has a probable detection."""
        probable = (item.object for group in scales for item in group if item.score >= PROBABLE)
        return set(self._names) <= set(probable)

    def _searched_depths(self, view: NetworkView) -> list[tuple[float, float] | None] | None:
        """Return the depths at which :func:`.recover_batch` searches each part, metres.

        A part has None if its training distances are unknown. Without verification, which chooses
        between the poses, nothing is searched, and the result is None.
        """
        if self.refiner is None or not self.refiner.verifies:
            return None
        seen = self.checkpoint.seen
        return [
            view.depths(seen[part.name], part.diameter) if part.name in seen else None
            for part in self.parts
        ]

    def views(
        self,
        image: RGBImage,
        K: CameraMatrix,
        distances: Distances | None = None,
        roi: Region | None = None,
    ) -> list[NetworkView]:
        """Return the inputs of the network for an image; see :meth:`predict` for the arguments."""
        multiple = self.network.size_multiple
        return network_views(self.checkpoint, multiple, image, K, distances, roi)

    def maps(self, image: RGBImage) -> Maps:
        """Return belief and field maps of an RGB image (sides: multiples of ``size_multiple``)."""
        pixels = torch.from_numpy(image).to(self.device).permute(2, 0, 1)[None]
        with torch.inference_mode():
            belief, field = self.network.maps(pixels)
        return belief[0].float(), field[0].float()


def search_again(
    estimator: PoseEstimator, camera: Camera, result: PoseResult, **options: Unpack[StreamOptions]
) -> tuple[PoseResult, str]:
    """Search for parts at all distances in an image of a stream without detections.

    Returns:
        The new result, and why it has no detections (an empty string if it has any).
    """
    if not isinstance(estimator, NetworkEstimator):
        return result, "no pose at these distances passes the verification"
    from dopepp.inference.frames.source import Lens  # the sources are slow to import

    image, K, distances = result.image, result.K, options.get("distances")
    path, scale = options.get("depth"), options.get("depth_scale", 0.001)
    lens = Lens(camera, crop=options.get("crop"))
    depth = None if path is None else lens.read_depth(path, scale, K)
    region = options.get("roi"), lens.is_cropped
    if distances is None:
        candidates = estimator.candidates(image, K, None, depth, "any", *region)
        detections, weaker = estimator.split(candidates)
        if detections:
            return replace(result, detections=detections, weaker=weaker), ""
    return result, format_reasons(estimator.explain(image, K, depth, distances, *region))
