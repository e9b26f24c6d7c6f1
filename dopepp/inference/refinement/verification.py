"""Verification: the probability that a pose is correct, from the image at that pose.

A pose is correct if ADD(-S) is below a tenth of the part's diameter. The features describe how well
the part, drawn at the pose, explains the image: its outline, creases, colours and shading. Except
for ``moved``, no feature depends on a network, so a single small model serves all parts. The model
was learned from refined poses of procedural parts (``benchmarks/learn_verification.py``), and its
weights are in ``verification.json``.

To add a feature, name it in :data:`EVIDENCE`, compute it in :meth:`Verifier.evidence`, and learn
the model again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Int16, UInt8

from dopepp.core.compiled import Array, compiled
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Transform, resize_camera
from dopepp.inference.refinement.colour import SMALLEST_PX, Crop, crop_around, log_odds
from dopepp.inference.refinement.creases import SharpEdges
from dopepp.inference.refinement.outline import (
    Contour,
    OutlineMesh,
    PosedMesh,
    find_contour,
    posed,
)
from dopepp.inference.refinement.solver import PoseMatrix, UndecidedError

if TYPE_CHECKING:
    from dopepp.recovery.detection import Detection

EVIDENCE: Final = (
    "outline",  # mean response of the image's edges along the outline, in [0, 1]
    "outline_gain",  # outline response minus the response of shifted outlines on clutter
    "outline_weakest",  # mean response of the second weakest eighth of the outline
    "crease",  # mean response along visible creases
    "crease_gain",  # crease response minus the response of shifted creases
    "creases",  # ratio of crease points to outline points, at most 1
    "contrast",  # difference of the colours on both sides of the outline, in [0, 1]
    "inside",  # mean log odds of the colours inside the outline
    "outside",  # mean log odds of the colours around it
    "shading",  # share of the variance inside that a linear model of the normals explains
    "residual",  # logarithm of the ratio of unexplained deviations, inside to surroundings
    "moved",  # Mahalanobis distance from the network's pose
    "spread",  # logarithm of the stated deviation of the part's points in tenths of the diameter
    "size",  # logarithm of the extent in the image in units of 100 pixels
)
"""Features of a pose and an image, in the order in which the verification model reads them."""

LONGEST_PX: Final = 120  # approximate length of the part on the crop
SPACING: Final = 80.0  # number of sampled points along the part's extent
NOISE: Final = 8.0  # gradient, grey levels per pixel, at which an edge has half its response
SHIFTED: Final = 0.12  # distance of the shifted outlines, share of the extent
COLOUR_PX: Final = 2.5  # distance from the outline at which colours are compared
RING: Final = 0.2  # width of the surroundings, share of the extent
MAX_PIXELS: Final = 1500  # largest number of pixels for the fit of the shading model
SECTORS: Final = 8
MIN_POINTS: Final = 12  # smallest number of outline points on the image
COMPARED_PX: Final = 300  # approximate length of the part where two poses are compared
MIN_DISTANCE: Final = 0.02  # distance of distinctive lines from other lines, share of the extent
MIN_DIFFERENCE: Final = 0.1  # difference of mean responses above which a pose is preferred
SCHARR: Final = 1 / 32  # grey levels per pixel in a sum of Scharr's kernel

Gradients = tuple[Int16[np.ndarray, "height width 3"], Int16[np.ndarray, "height width 3"]]
"""Derivatives of every channel along x and y, in sums of Scharr's kernel."""


class VerificationModel(NamedTuple):
    """A network of one hidden layer, with the mean and scale that normalise its inputs."""

    mean: Float[np.ndarray, "evidence"]
    scale: Float[np.ndarray, "evidence"]
    hidden: Float[np.ndarray, "evidence units"]
    hidden_bias: Float[np.ndarray, "units"]
    output: Float[np.ndarray, "units"]
    bias: Float[np.ndarray, ""]

    def log_odds(self, evidence: Float[np.ndarray, "*n evidence"]) -> Float[np.ndarray, "*n"]:
        """Return the logarithm of the odds that each pose is correct."""
        inputs = np.clip((evidence - self.mean) / self.scale, -4.0, 4.0)
        return np.asarray(
            np.tanh(inputs @ self.hidden + self.hidden_bias) @ self.output + self.bias
        )


@cache
def learned_model() -> VerificationModel:
    """Return the model that ships with the package.

    Raises:
        ValueError: The model was fitted to other evidence than ``EVIDENCE``.
    """
    path = files("dopepp.inference.refinement").joinpath("verification.json")
    values: dict[str, Any] = json.loads(path.read_text("utf-8"))
    if tuple(values["evidence"]) != EVIDENCE:
        raise ValueError(f"{path} was fitted to other evidence: run {values['command']}")
    arrays = [np.array(values[name]) for name in VerificationModel._fields]
    return VerificationModel(*arrays)


class Verifier:
    """Verifies poses of one part.

    Args:
        mesh: Mesh of the part.
        diameter: Diameter of the part, metres.
    """

    def __init__(self, mesh: OutlineMesh, diameter: float) -> None:
        self.mesh, self._diameter = mesh, diameter
        self._edges = SharpEdges(mesh)
        self._normals = self._edges.normals
        spread = mesh.vertices - mesh.vertices.mean(axis=0)
        self._moment = spread.T @ spread / len(spread)

    def probability(
        self, detection: Detection, image: RGBImage, K: CameraMatrix, moved: float
    ) -> float:
        """Return the probability that a detection's pose is correct; 0 if it is not on the image.

        ``moved`` is the Mahalanobis distance of the pose from that before refinement.
        """
        T_cam_obj, covariance = detection.T_cam_obj, detection.covariance
        evidence = self.evidence(image, K, T_cam_obj, covariance, moved)
        if evidence is None:
            return 0.0
        return float(1 / (1 + np.exp(-learned_model().log_odds(evidence))))

    def responses(
        self, image: RGBImage, K: CameraMatrix, poses: Sequence[Transform]
    ) -> Float[np.ndarray, "poses"]:
        """Return the mean response along the outline and the creases of a part at each pose.

        Args:
            image: RGB.
            K: Camera matrix, pixels.
            poses: Poses T_cam_obj at the same place, metres.
        """
        crop = self._crop_of([poses[0]], image, K, LONGEST_PX)
        if crop is None:
            return np.zeros(len(poses))
        gradients, means = _gradients(crop.colours), np.zeros(len(poses))
        for number, pose in enumerate(poses):
            at = posed(self.mesh, pose, crop.K)
            if at is not None:
                lines = np.concatenate(self._drawn(at, crop)[1:])
                responses = np.zeros(len(lines))
                _respond(*gradients, lines, np.zeros((1, 2)), responses)
                means[number] = responses.sum() / max(len(lines), 1)
        return means

    def margins(
        self, image: RGBImage, K: CameraMatrix, poses: Sequence[Transform]
    ) -> Float[np.ndarray, "poses poses"]:
        """Compare poses of look-alikes: by how much the lines of one fit better than of another.

        The poses share most lines, so their probabilities are nearly equal. Only lines that are
        apart from the lines of the other pose distinguish them, e.g. the edges of a small hole. For
        a pose without such lines, half the mean response of the shared lines is used.

        Args:
            image: RGB.
            K: Camera matrix, pixels.
            poses: Poses T_cam_obj, metres.

        Returns:
            Mean response of the distinguishing lines of the first pose (row) minus that of the
            second (column). A pose should be preferred above :data:`MIN_DIFFERENCE`. All entries
            are 0 if the part is not on the image.
        """
        margins = np.zeros((len(poses), len(poses)))
        crop = self._crop_of(poses, image, K, COMPARED_PX)
        if crop is None:
            return margins
        factor = max(1, round(COMPARED_PX / crop.extent))  # small holes need many pixels
        size = factor * crop.size[0], factor * crop.size[1]
        K = resize_camera(crop.K, factor, factor)
        enlarged = np.asarray(cv2.resize(crop.colours, size, interpolation=cv2.INTER_CUBIC))
        gx, gy = _gradients(enlarged)
        strengths = factor * SCHARR * np.hypot(gx, gy).max(axis=2)
        responses = (strengths / (strengths + NOISE)).ravel()
        lines, are_apart = [], []  # pixels on lines, and whether each pixel is apart from lines
        for pose in poses:
            drawn = self._line_pixels(pose, K, size)
            distance = cv2.distanceTransform((~drawn).astype(np.uint8), cv2.DIST_L2, 3)
            lines.append(np.flatnonzero(drawn))
            are_apart.append((distance > MIN_DISTANCE * factor * crop.extent).ravel())
        for i, j in combinations(range(len(poses)), 2):
            distinctive, shared = [], []
            for own, other in (i, j), (j, i):
                is_apart = are_apart[other][lines[own]]
                distinctive.append(responses[lines[own][is_apart]])
                shared.append(responses[lines[own][~is_apart]])
            common = np.concatenate(shared)
            level = common.mean() / 2 if len(common) else 0.0
            first, second = (values.mean() if len(values) else level for values in distinctive)
            margins[i, j], margins[j, i] = first - second, second - first
        return margins

    def _drawn(
        self, at: PosedMesh, crop: Crop
    ) -> tuple[
        Int[np.ndarray, "height width"],
        Float[np.ndarray, "points 4"],
        Float[np.ndarray, "creases 4"],
    ]:
        """Return the triangle at each pixel (−1 for none), and points of outline and creases.

        A point has its pixel (x, y) and unit normal (x, y).
        """
        ids, spacing = self._edges.drawn(at, crop.size), max(1.5, 3.0 * crop.extent / SPACING)
        contour = find_contour(self.mesh, at, (ids >= 0).astype(np.uint8), spacing)
        return ids, _lines(contour), self._edges.visible(at, ids, spacing)

    def _crop_of(
        self, poses: Sequence[Transform], image: RGBImage, K: CameraMatrix, longest_px: int
    ) -> Crop | None:
        """Cut out the part at several poses; None if it is too small or not on the image."""
        drawn = [posed(self.mesh, pose, K) for pose in poses]
        if any(at is None for at in drawn):
            return None
        pixels = np.concatenate([at.pixels for at in drawn if at is not None])
        pixels = pixels.T.copy()  # numpy reduces long rows much faster than long columns
        corners = np.array([pixels.min(axis=1), pixels.max(axis=1)])
        try:
            return crop_around(image, K, corners, longest_px)
        except UndecidedError:
            return None

    def _line_pixels(
        self, pose: Transform, K: CameraMatrix, size: tuple[int, int]
    ) -> Bool[np.ndarray, "height width"]:
        """Return the pixels of outline and visible creases; see :meth:`SharpEdges.lines`.

        Args:
            pose: T_cam_obj, metres.
            K: Camera matrix, pixels.
            size: Width and height, pixels.
        """
        at = posed(self.mesh, pose, K)
        assert at is not None  # the caller has projected the part
        return self._edges.lines(at, size)

    def evidence(
        self,
        image: RGBImage,
        K: CameraMatrix,
        T_cam_obj: Transform,
        covariance: PoseMatrix,
        moved: float,
    ) -> Float[np.ndarray, "evidence"] | None:
        """Return the :data:`EVIDENCE` about a pose; None if too little of the part is on the image.

        Args:
            image: RGB.
            K: Camera matrix, pixels.
            T_cam_obj: Pose, metres.
            covariance: Covariance of the pose, as in :class:`PartRefiner`; camera axes.
            moved: Mahalanobis distance from the pose before refinement.
        """
        crop = self._crop_of([T_cam_obj], image, K, LONGEST_PX)
        at = None if crop is None else posed(self.mesh, T_cam_obj, crop.K)
        if crop is None or at is None:
            return None
        ids, outline, creases = self._drawn(at, crop)
        mask = (ids >= 0).astype(np.uint8)
        odds = log_odds(crop.bins, mask, 1.5, RING * crop.extent, 1)
        if len(outline) < MIN_POINTS or odds is None or mask.sum() < SMALLEST_PX**2:
            return None
        gradients = _gradients(crop.colours)
        along, shifted_outline = _responses(gradients, outline, SHIFTED * crop.extent)
        crease, shifted_crease = _responses(gradients, creases, SHIFTED * crop.extent)
        ring = cv2.dilate(mask, None, iterations=round(RING * crop.extent)) - mask
        within = mask.astype(bool)
        explained, residual = self._shading(crop.colours, ids, ring, T_cam_obj)
        return np.array(
            [
                along.mean(),
                along.mean() - shifted_outline,
                _weakest_sector(along, outline),
                crease.mean() if len(crease) else 0.0,
                crease.mean() - shifted_crease if len(crease) else 0.0,
                min(1.0, len(crease) / len(along)),
                _contrast(crop.colours, outline),
                odds[within].mean(),
                odds[ring.astype(bool)].mean(),
                explained,
                residual,
                min(moved, 20.0),
                self._spread(covariance, T_cam_obj),
                math.log(crop.extent / crop.scale / 100.0),
            ]
        )

    def _shading(
        self,
        colours: RGBImage,
        ids: Int[np.ndarray, "height width"],
        ring: UInt8[np.ndarray, "height width"],
        T_cam_obj: Transform,
    ) -> tuple[float, float]:
        """Fit a linear model of the surface normals to the colours inside the outline.

        Args:
            colours: Crop of the image.
            ids: Triangle at each pixel, −1 for none.
            ring: 1 in the surroundings of the part, else 0.
            T_cam_obj: Pose, metres.

        Returns:
            The features ``shading`` and ``residual`` of :data:`EVIDENCE`.
        """
        inside = np.flatnonzero(ids >= 0)
        inside = inside[:: math.ceil(len(inside) / MAX_PIXELS)]
        normals = self._normals[ids.ravel()[inside]] @ T_cam_obj[:3, :3].T
        rows = np.column_stack([np.ones(len(normals)), normals])
        seen = colours.reshape(-1, 3)[inside].astype(np.float64)
        normal_matrix = rows.T @ rows + 1e-3 * len(rows) * np.diag([0.0, 1.0, 1.0, 1.0])
        rest = seen - rows @ np.linalg.solve(normal_matrix, rows.T @ seen)
        total, unexplained = seen.T.copy().var(axis=1).sum(), (rest**2).sum() / len(rest)
        surroundings = float((cv2.meanStdDev(colours, mask=ring)[1] ** 2).sum())
        residual = 0.5 * math.log((unexplained + NOISE**2) / (surroundings + NOISE**2))
        return float(1 - unexplained / (total + NOISE**2)), residual

    def _spread(self, covariance: PoseMatrix, T_cam_obj: Transform) -> float:
        """Return the feature ``spread`` of :data:`EVIDENCE` for a pose and its covariance."""
        R = T_cam_obj[:3, :3]
        moment = R @ self._moment @ R.T
        arms = np.trace(moment) * np.eye(3) - moment  # mean of |ω × p|² as a form of ω
        variance = np.trace(covariance[3:, 3:]) + float((arms * covariance[:3, :3]).sum())
        deviation = math.sqrt(max(variance, 1e-18)) / (0.1 * self._diameter)
        return math.log(min(max(deviation, 1e-3), 1e3))


def _lines(contour: Contour) -> Float[np.ndarray, "points 4"]:
    """Return pixels and normals of a contour as one array."""
    return np.column_stack([contour.pixels, contour.normals])


def _gradients(colours: RGBImage) -> Gradients:
    """Return the derivatives of every channel."""
    soft = cv2.GaussianBlur(colours, (3, 3), 0.8)
    return cv2.Scharr(soft, cv2.CV_16S, 1, 0), cv2.Scharr(soft, cv2.CV_16S, 0, 1)


def _responses(
    gradients: Gradients,
    lines: Float[np.ndarray, "points 4"],
    distance: float,
) -> tuple[Float[np.ndarray, "points"], float]:
    """Return the gradient response at each point, and the mean response of shifted points.

    Args:
        gradients: Derivatives of the image along x and y.
        lines: Pixel (x, y) and unit normal (x, y) of each point.
        distance: Length of the eight shifts around each point, pixels.
    """
    angles = np.arange(8) * math.pi / 4
    shifts = distance * np.column_stack([np.cos(angles), np.sin(angles)])
    responses, shifted = np.zeros(len(lines)), np.zeros(len(lines))
    _respond(*gradients, lines, np.zeros((1, 2)), responses)
    _respond(*gradients, lines, shifts, shifted)
    return responses, float(shifted.mean() / len(shifts)) if len(lines) else 0.0


def _weakest_sector(
    responses: Float[np.ndarray, "points"], outline: Float[np.ndarray, "points 4"]
) -> float:
    """Return the mean response in the second weakest of the sectors around the outline's centre.

    Args:
        responses: Gradient response of each outline point.
        outline: Pixel (x, y) and normal (x, y) of each outline point.
    """
    offsets = outline[:, :2] - outline[:, :2].mean(axis=0)
    angles = np.arctan2(offsets[:, 1], offsets[:, 0])
    sector = np.minimum((angles / (2 * math.pi) + 0.5) * SECTORS, SECTORS - 1).astype(int)
    counts = np.bincount(sector, minlength=SECTORS)
    means = np.bincount(sector, responses, SECTORS)[counts > 0] / counts[counts > 0]
    return float(np.sort(means)[min(1, len(means) - 1)])


def _contrast(colours: RGBImage, outline: Float[np.ndarray, "points 4"]) -> float:
    """Return the mean difference of colours across an outline, relative to noise, in [0, 1]."""
    height, width = colours.shape[:2]
    sides = []
    for side in (-COLOUR_PX, COLOUR_PX):
        pixels = np.rint(outline[:, :2] + side * outline[:, 2:]).astype(int)
        columns, rows = np.clip(pixels[:, 0], 0, width - 1), np.clip(pixels[:, 1], 0, height - 1)
        sides.append(colours[rows, columns].astype(np.float64))
    difference = np.abs(sides[0] - sides[1]).max(axis=1)
    return float((difference / (difference + 2 * NOISE)).mean())


@compiled()
def _respond(gx: Array, gy: Array, lines: Array, shifts: Array, responses: Array) -> None:
    """Add to ``responses`` each point's gradient response, summed over the shifts.

    A response is near 1 for a strong image gradient along the point's normal, and 0 for none. Of
    three pixels along the normal, the pixel with the largest response counts, and of its colour
    channels, the channel with the largest gradient.

    Args:
        gx: Derivative of each channel along x.
        gy: Derivative of each channel along y.
        lines: Pixel (x, y) and unit normal (x, y) of each point.
        shifts: Offsets (x, y) at which every point is evaluated, pixels.
        responses: One sum per point, updated in place.
    """
    height, width = gx.shape[:2]
    for i in range(len(lines)):
        nx, ny = lines[i, 2], lines[i, 3]
        for s in range(len(shifts)):
            x, y = lines[i, 0] + shifts[s, 0], lines[i, 1] + shifts[s, 1]
            most = 0.0
            for k in range(3):
                u = round(x + (k - 1.0) * nx)
                v = round(y + (k - 1.0) * ny)
                if 0 <= u < width and 0 <= v < height:
                    longest = dx = dy = -1
                    for c in range(3):
                        a, b = int(gx[v, u, c]), int(gy[v, u, c])
                        if a * a + b * b > longest:
                            longest, dx, dy = a * a + b * b, a, b
                    along, length = abs(dx * nx + dy * ny), np.float32(math.sqrt(longest))
                    most = max(most, along / (length + NOISE / SCHARR))
            responses[i] += most
