"""Detector of one part by templates of its mesh: it returns start poses with scores."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    crop_camera,
    focal_length,
    make_transform,
    project_keypoints,
    resize_camera,
)
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.geometry.symmetry import rotations_about, symmetry_group
from dopepp.inference.input_image import Region
from dopepp.inference.network_input import MAX_PIXELS
from dopepp.inference.refinement.outline import filled_mask, make_outline_mesh, posed
from dopepp.inference.templates.matching import STRIDE, Matches, match
from dopepp.inference.templates.ranking import (
    FEATURES,
    Features,
    improve_views,
    learned_ranking,
    move_nearby,
)
from dopepp.inference.templates.responses import edge_responses
from dopepp.inference.templates.turns import nearly_round_turns
from dopepp.inference.templates.views import (
    NEAREST,
    concatenate_templates,
    make_templates,
    view_rotations,
)
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection

COARSE_PX: Final = 80.0  # diameter of the part above which the image is shrunk for the search
FINE_PX: Final = 140.0  # diameter of the part above which the image is shrunk for the ranking
SMALLEST_PX: Final = 12.0  # smallest diameter that templates can detect
SCALE_STEP: Final = 1.13  # ratio of neighbouring distances
PERSPECTIVE: Final = 0.15  # difference of diameter / distance between two sets of drawings
OCTAVE: Final = 2.0  # largest ratio of the diameters that are ranked on the same resized image
COARSE_SPREAD: Final = 5  # `spread` of the edges in the search, pixels
FINE_SPREAD: Final = 3  # `spread` of the edges in the ranking, pixels

NUM_RANKED: Final = 16000  # best matches that are ranked
NUM_TURNED: Final = 1000  # best matches of each octave that are compared with neighbouring views
EXTENT: Final = 2.5  # added to the score per diameter of a view's extent, standard deviations
NUM_STARTS: Final = 200  # start poses

# Two start poses that differ by less are duplicates: refinement would move both to the same pose.
SAME_PLACE: Final = 0.1  # diameters
SAME_DEPTH: Final = 0.05  # share of the depth
SAME_TURN: Final = math.radians(10.0)

SILHOUETTE_PX: Final = 64  # diameter of the part where its area is measured

# Standard deviations of a start pose.
TURN_ERROR: Final = math.radians(6.0)
PLACE_ERROR: Final = 0.02  # diameters
DEPTH_ERROR: Final = 0.03  # share of the depth


class TemplateDetector:
    """Detects one part by templates of its mesh.

    Args:
        part: Part with a mesh.
        working_distance: Nearest and farthest depth of the part, metres.
        tilt_deg: Largest angle between the part's z axis and the direction to the camera, degrees.

    Raises:
        UserError: The part has no mesh.
    """

    def __init__(
        self, part: Part, working_distance: tuple[float, float], tilt_deg: float = 180.0
    ) -> None:
        if part.mesh is None:
            fix = "pass the part's mesh file"
            raise UserError(
                f"templates of {part.name}, which has no mesh", "a part with a mesh", fix
            )
        self.part, self._distances, self._tilt_deg = part, working_distance, tilt_deg
        self._mesh = mesh = make_outline_mesh(part.mesh.vertices, part.mesh.faces)
        self._centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous, max_step=0.1)
        self._half_turns = _half_turns(self._centre, group)
        self._round_turns = []
        if not part.symmetries_continuous:  # with these, a turn is a symmetry
            rotations, extent = group[:, :3, :3], part.diameter
            turns = nearly_round_turns(part.mesh, self._centre, extent, rotations)
            self._round_turns = [rotations_about(self._centre, it) for it in turns]
        rotations = view_rotations(tilt_deg, group[:, :3, :3])
        # Near the camera, the perspective of a part changes strongly with its distance.
        nearness = np.minimum(part.diameter / np.array(working_distance), 1 / NEAREST)
        count = max(1, math.ceil((nearness[0] - nearness[1]) / PERSPECTIVE))
        steps = (np.arange(count) + 0.5) / count
        self._nearness = nearness[0] + (nearness[1] - nearness[0]) * steps
        self._groups = [
            make_templates(mesh, self._centre, part.diameter, part.diameter / near, rotations)
            for near in self._nearness
        ]
        self._templates = concatenate_templates(self._groups)

    def detect(
        self,
        image: RGBImage,
        K: CameraMatrix,
        distances: tuple[float, float] | None = None,
        roi: Region | None = None,
    ) -> list[Detection]:
        """Search an image for the part.

        Args:
            image: RGB, without distortion.
            K: Camera matrix, pixels.
            distances: Nearest and farthest depth, metres (default: the working distance).
            roi: Region to search: (x, y, width, height), pixels.

        Returns:
            Start poses, best score first. Several may belong to the same instance.

        Raises:
            UserError: The part is too small on the image to be detected.
        """
        shown, left, top = image, 0, 0
        if roi is not None:
            left, top, width, height = (round(number) for number in roi)
            shown = np.ascontiguousarray(image[top : top + height, left : left + width])
        views, poses, features = self.ranked(
            shown, crop_camera(K, left, top), distances or self._distances
        )
        model = learned_ranking()
        odds = features @ model.weights + model.bias
        # The normalised edges of narrow views are low, because straight lines fit everywhere. The
        # best matches with and without this feature therefore take turns.
        edges = FEATURES.index("edges")
        ranks = [np.argsort(-odds), np.argsort(features[:, edges] * model.weights[edges] - odds)]
        order = np.array(list(dict.fromkeys(np.column_stack(ranks).ravel().tolist())))
        transforms = self.transforms(views[order], poses[order], crop_camera(K, left, top))
        scores = 1 / (1 + np.exp(-np.clip(odds[order], -30.0, 30.0)))
        chosen = distinct_poses(transforms, self.part, NUM_STARTS)
        chosen.sort(key=lambda index: -scores[index])
        return [self.start(transforms[i], float(scores[i]), K) for i in chosen]

    def start(self, T_cam_obj: Transform, score: float, K: CameraMatrix) -> Detection:
        """Return a detection at a pose, with the covariance of start poses and without peaks.

        Args:
            T_cam_obj: Pose, metres.
            score: Score of the detection, in [0, 1].
            K: Camera matrix, pixels.
        """
        depth = float(T_cam_obj[2, 3])
        deviations = (
            [TURN_ERROR] * 3 + [PLACE_ERROR * self.part.diameter] * 2 + [DEPTH_ERROR * depth]
        )
        keypoints = project_keypoints(self.part.cuboid, T_cam_obj, K)
        return Detection(
            object=self.part.name,
            score=score,
            belief=score,
            T_cam_obj=T_cam_obj,
            keypoints=keypoints,
            peaks=np.full_like(keypoints, np.nan),
            reprojection_error_px=0.0,
            covariance=np.diag(np.square(deviations)),
        )

    def half_turned(self, T_cam_obj: Transform) -> list[Transform]:
        """Return a pose after half turns of the part about the axes of its cuboid.

        Half turns that are symmetries of the part are omitted, and poses beyond the largest tilt.
        """
        return self._within_tilt(T_cam_obj @ turn for turn in self._half_turns)

    def turned(self, T_cam_obj: Transform) -> list[list[Transform]]:
        """Return a pose after turns of a nearly round part, a list for each axis and side.

        Poses beyond the largest tilt are omitted; other parts have no list.
        """
        turned = (self._within_tilt(T_cam_obj @ turns) for turns in self._round_turns)
        return [poses for poses in turned if poses]

    def _within_tilt(self, poses: Iterable[Transform]) -> list[Transform]:
        """Return the poses up to the largest tilt."""
        return [pose for pose in poses if self._tilt(pose) <= math.radians(self._tilt_deg)]

    def _tilt(self, T_cam_obj: Transform) -> float:
        """Return the angle between the part's z axis and the direction to the camera, radians."""
        to_camera = -(T_cam_obj[:3, :3] @ self._centre + T_cam_obj[:3, 3])
        cosine = T_cam_obj[:3, 2] @ to_camera / np.linalg.norm(to_camera)
        return math.acos(min(max(float(cosine), -1.0), 1.0))

    def silhouette(self, T_cam_obj: Transform, image: RGBImage, K: CameraMatrix) -> float:
        """Return the area of the part's silhouette on an image, squared projected diameters.

        Args:
            T_cam_obj: Pose, metres.
            image: Image whose borders limit the silhouette.
            K: Camera matrix, pixels.
        """
        depth = float((T_cam_obj[:3, :3] @ self._centre + T_cam_obj[:3, 3])[2])
        scale = SILHOUETTE_PX * depth / (self.part.diameter * focal_length(K))
        posed_mesh = posed(self._mesh, T_cam_obj, resize_camera(K, scale, scale))
        size = math.ceil(scale * image.shape[1]), math.ceil(scale * image.shape[0])
        area = 0 if posed_mesh is None else int(filled_mask(self._mesh, posed_mesh, size).sum())
        return max(area, 1) / SILHOUETTE_PX**2

    def ranked(
        self, image: RGBImage, K: CameraMatrix, distances: tuple[float, float]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the best matches at all distances.

        Args:
            image: RGB.
            K: Camera matrix, pixels.
            distances: Nearest and farthest depth, metres.

        Returns:
            Index of the template, pose on the image and features of each match. A match with a
            replaced view has the mean of the features before and after the replacement.

        Raises:
            UserError: The part is too small on the image to be detected.
        """
        sizes = self._sizes(image, K, distances)
        groups = [self._matches(image, size, size / focal_length(K)) for size in sizes]
        matches = _concatenate(groups)
        promise = matches.scores + EXTENT * self._templates.extents[matches.views]
        matches = matches.at(np.argsort(-promise)[:NUM_RANKED])
        octaves = np.floor(np.log(sizes[0] / matches.poses[:, 3]) / math.log(OCTAVE) + 1e-9)
        members = [matches.at(octaves == octave) for octave in np.unique(octaves)]
        ranked, features = zip(
            *(self._ranked_octave(image, group) for group in members), strict=True
        )
        matches = _concatenate(ranked)
        return matches.views, matches.poses, np.concatenate(features)

    def _sizes(
        self, image: RGBImage, K: CameraMatrix, distances: tuple[float, float]
    ) -> Float[np.ndarray, "sizes"]:
        """Return the projected diameters to search, pixels, largest first.

        Raises:
            UserError: The smallest diameter is too small after the image is shrunk to MAX_PIXELS.
        """
        near, far = distances
        length = self.part.diameter * focal_length(K)  # at a depth of one metre, pixels
        count = max(1, math.ceil(math.log(far / near) / math.log(SCALE_STEP)))
        sizes = length / (near * (far / near) ** ((np.arange(count) + 0.5) / count))
        least = math.sqrt(image.shape[0] * image.shape[1] / MAX_PIXELS)
        if sizes[-1] / max(least, 1.0) < SMALLEST_PX:
            raise UserError(
                f"{self.part.name}, {sizes[-1]:.0f} pixels long at {far:g} m in an image of "
                f"{image.shape[1]}×{image.shape[0]}",
                f"at least {SMALLEST_PX * max(least, 1.0):.0f} pixels",
                "search a region (roi), or state a nearer working distance",
            )
        return np.asarray(sizes)

    def _ranked_octave(self, image: RGBImage, matches: Matches) -> tuple[Matches, Features]:
        """Move matches of similar size, and replace views of the best by neighbouring views.

        Args:
            image: RGB.
            matches: Matches whose sizes differ by at most a factor of ``OCTAVE``.

        Returns:
            The best moved matches, followed by the same matches with replaced views, and the
            features of both.
        """
        scale = min(1.0, FINE_PX / matches.poses[:, 3].max())
        small = _resized(image, scale)
        responses = edge_responses(small, FINE_SPREAD, _odd(FINE_PX))
        reach = 1 + STRIDE / 2 * float(matches.poses[:, 3].mean()) * scale / COARSE_PX
        matches.poses[:, [0, 1, 3]] *= scale
        matches, before = move_nearby(matches, self._templates, responses, small, reach)
        best = np.argsort(-before @ learned_ranking().weights)[:NUM_TURNED]
        matches = matches.at(best)
        improved, after = improve_views(matches, self._templates, responses, small)
        both = _concatenate([matches, improved])
        both.poses[:, [0, 1, 3]] /= scale
        # Wrong matches also have neighbouring views that fit better, so half of the gain counts.
        return both, np.concatenate([before[best], (before[best] + after) / 2])

    def _matches(self, image: RGBImage, size: float, nearness: float) -> Matches:
        """Return the best matches of all templates at one distance.

        Args:
            image: RGB.
            size: Projected diameter of the part at this distance, pixels.
            nearness: Diameter divided by the distance, which selects the set of drawings.
        """
        most = math.sqrt(MAX_PIXELS / (image.shape[0] * image.shape[1]))
        scale = min(1.0, most, COARSE_PX / size)
        small = _resized(image, scale)
        responses = edge_responses(small, COARSE_SPREAD, _odd(size * scale))
        group = int(np.abs(self._nearness - nearness).argmin())
        matches = match(responses, self._groups[group], size * scale)
        matches.poses[:, [0, 1, 3]] /= scale
        return matches._replace(views=matches.views + group * len(self._groups[0].points))

    def transforms(
        self, views: np.ndarray, poses: np.ndarray, K: CameraMatrix
    ) -> Float[np.ndarray, "matches 4 4"]:
        """Convert matches of templates to poses of the part, metres.

        Args:
            views: Index of each match's template.
            poses: Columns of each match: pixel (u, v) of the part's centre, rotation in the image
                plane in radians, and projected diameter in pixels.
            K: Camera matrix, pixels.
        """
        u, v, rolls, sizes = poses.T
        depths = self.part.diameter * focal_length(K) / sizes
        rays = np.column_stack(
            [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(poses))]
        )
        # Templates show the part on the optical axis: rotate this axis to the ray of the match.
        sines = np.linalg.norm(rays[:, :2], axis=1) / np.linalg.norm(rays, axis=1)
        axes = np.column_stack([-rays[:, 1], rays[:, 0], np.zeros(len(rays))])
        axes *= (np.arcsin(sines) / np.maximum(np.linalg.norm(axes, axis=1), 1e-12))[:, None]
        rolled = rotation_vector_to_matrix(rolls[:, None] * np.array([0.0, 0.0, 1.0]))
        rotations = rotation_vector_to_matrix(axes) @ rolled @ self._templates.rotations[views]
        return make_transform(rotations, depths[:, None] * rays - rotations @ self._centre)


def _concatenate(groups: Sequence[Matches]) -> Matches:
    """Concatenate groups of matches."""
    return Matches(*(np.concatenate(columns) for columns in zip(*groups, strict=True)))


def distinct_poses(
    transforms: Sequence[Transform] | Float[np.ndarray, "poses 4 4"],
    part: Part,
    most: int | None = None,
) -> list[int]:
    """Return the indices of the first ``most`` poses that do not duplicate an earlier pose.

    Args:
        transforms: Poses T_cam_obj, best first.
        part: Part, whose diameter and centre define duplicates (``SAME_PLACE`` and others).
        most: Largest number of poses (default: all).
    """
    poses = np.reshape(transforms, (-1, 4, 4))
    centres = poses[:, :3, :3] @ part.cuboid[-1] + poses[:, :3, 3]
    free, chosen = np.ones(len(poses), bool), []
    for index in range(len(poses)):
        if not free[index]:
            continue
        chosen.append(index)
        if len(chosen) == most:
            break
        distances = np.linalg.norm(centres[:, :2] - centres[index, :2], axis=1)
        trace = np.einsum("nij,ij->n", poses[:, :3, :3], poses[index, :3, :3])
        free &= (
            (distances > SAME_PLACE * part.diameter)
            | (np.abs(centres[:, 2] / centres[index, 2] - 1) > SAME_DEPTH)
            | (trace < 1 + 2 * math.cos(SAME_TURN))
        )
    return chosen


def _half_turns(
    centre: Float[np.ndarray, "3"], group: Float[np.ndarray, "symmetries 4 4"]
) -> list[Transform]:
    """Return half turns about the object's axes through a point, except the part's symmetries.

    Args:
        centre: Point on the three axes, object frame, metres.
        group: Symmetries of the part; half turns near one of them are omitted.
    """
    turns = []
    for axis in np.eye(3):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        traces = np.einsum("nij,ij->n", group[:, :3, :3], R)
        if traces.max() < 1 + 2 * math.cos(SAME_TURN):
            turns.append(make_transform(R, centre - R @ centre))
    return turns


def _resized(image: RGBImage, scale: float) -> RGBImage:
    """Shrink an image by a factor; factors of 1 and above leave it unchanged."""
    if scale >= 1.0:
        return image
    size = [max(8, round(scale * side)) for side in image.shape[1::-1]]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _odd(side: float) -> int:
    """Round a length down to an integer, and even integers up to the next odd integer."""
    return int(side) | 1
