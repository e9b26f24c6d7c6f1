"""PoseTracker: tracks parts from frame to frame and runs the network only where necessary.

Refinement alone (:mod:`dopepp.inference.refinement.region`) searches a part of the last frame near
the pose that its motion predicts: first close to the prediction, then as far as a hand may have
moved the part. If neither pose is accepted, the network is run on the surroundings. If the network
does not detect the part either, the part is lost, and the network is run on every frame until the
part reappears, under the same identity.

A Kalman filter estimates pose and velocity of a part. The covariance of each frame's pose already
contains the filter's prediction, because the prediction was the refinement's prior. The velocity is
therefore updated by the correction of the pose, and a converging pose does not appear as motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
import scipy  # SciPy loads its submodules on first use
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import (
    CameraMatrix,
    Step,
    Transform,
    move_pose,
    project_keypoints,
    step_between,
    transform,
)
from dopepp.inference.network_input import Region, prepare_image
from dopepp.recovery.detection import Detection

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator

AROUND: Final = 0.5
"""Margin of the region in which the network searches a doubtful part, share of its extent."""

NEAR: Final = 0.5
"""Largest distance between the centres of a track and a detection of the same part, diameters."""

ELSEWHERE: Final = 0.1
"""Mean distance between keypoints above which track and detection disagree, diameters."""

OUTVOTED: Final = 2  # consecutive disagreeing detections after which a track moves to them

DOUBTFUL: Final = 0.8
"""Share of the usual agreement below which a track is doubtful. On rendered sequences, the share
was 0.97 at correct poses, and 0.5 at poses that an occluder had displaced."""

TRUSTED: Final = 0.6
"""Agreement below which a pose is rejected (unless the first pose agreed less): half of a wrong
pose's outline may coincide with other edges."""

SURE: Final = 0.85  # agreement below which the network is run every OFTEN frames
OFTEN: Final = 5
USUAL: Final = 0.1  # weight of a frame in the usual agreement

PATIENCE: Final = 6
"""Number of consecutive doubtful frames in which a part continues its motion before it is lost."""

FORGOTTEN: Final = 300  # frames after which a lost part is no longer searched

STILL: Final = (math.radians(0.05), 2e-4)
"""Standard deviations of the change in velocity of a part at rest, per frame: radians about each
axis, and metres per metre of distance. Smaller values reduce jitter."""

SUDDEN: Final = (math.radians(4.0), 0.025)
"""Like :data:`STILL`, for a part that a hand moves by up to 8° and 5 % of the distance per frame
(two standard deviations)."""

SWERVE: Final = 0.6
"""Factor on speed plus last correction: further standard deviation of the change in velocity."""

PERSISTENCE: Final = 0.95  # share of the velocity that remains after a frame


@dataclass(frozen=True, eq=False)
class Motion:
    """State of the Kalman filter: pose and velocity of a part."""

    T_cam_obj: Transform
    # Rotation per frame (rotation vector about the object's origin, radians) and shift (metres),
    # both in camera axes
    velocity: Step
    covariance: Float[np.ndarray, "12 12"]  # joint covariance of pose and velocity
    correction: Step  # step from the predicted pose to the updated pose

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of the pose alone."""
        return self.covariance[:6, :6]

    def predict(self, sudden: bool = False) -> Motion:
        """Predict the motion on the next frame; ``sudden`` permits a large change in velocity."""
        step = np.eye(12)
        step[:6, 6:] = step[6:, 6:] = PERSISTENCE * np.eye(6)
        added = np.kron([[1.0, 1.0], [1.0, 1.0]], np.diag(self._velocity_change(sudden) ** 2))
        return Motion(
            move_pose(self.T_cam_obj, PERSISTENCE * self.velocity),
            PERSISTENCE * self.velocity,
            step @ self.covariance @ step.T + added,
            self.correction,
        )

    def update(self, T_cam_obj: Transform, covariance: Float[np.ndarray, "6 6"]) -> Motion:
        """Update a prediction by a pose whose covariance already contains the prediction."""
        correction = step_between(self.T_cam_obj, T_cam_obj)
        predicted = self.pose_covariance
        gain = self.covariance[:, :6] @ np.linalg.inv(predicted)
        velocity = self.velocity + gain[6:] @ correction
        updated = self.covariance - gain @ (predicted - covariance) @ gain.T
        return Motion(T_cam_obj, velocity, updated, correction)

    def _velocity_change(self, sudden: bool) -> Step:
        """Return the standard deviations of the velocity's change per frame, radians and metres."""
        least = SUDDEN if sudden else STILL
        deviations = []
        for number, unit in enumerate((1.0, float(self.T_cam_obj[2, 3]))):
            axes = slice(3 * number, 3 * number + 3)
            speeds = np.linalg.norm(self.velocity[axes]), np.linalg.norm(self.correction[axes])
            deviations.append(max(least[number] * unit, SWERVE / math.sqrt(3) * float(sum(speeds))))
        return np.repeat(deviations, 3)


def at_rest(T_cam_obj: Transform, covariance: Float[np.ndarray, "6 6"]) -> Motion:
    """Return the motion of a part after its first frame: at rest, with an uncertain velocity."""
    both = np.zeros((12, 12))
    both[:6, :6] = covariance
    rotation, shift = SUDDEN
    both[6:, 6:] = np.diag(np.repeat([rotation, shift * float(T_cam_obj[2, 3])], 3) ** 2)
    return Motion(T_cam_obj, np.zeros(6), both, np.zeros(6))


@dataclass(frozen=True)
class Track:
    """Pose and velocity of a tracked part in one frame."""

    identity: int  # number of the instance, kept while the part is tracked or lost
    detection: Detection  # this frame's pose, with score and peaks of the network's last run
    # Motion per frame in camera axes: rotation vector about the object's origin (radians), and
    # shift (metres)
    velocity: Step
    detected: bool  # whether this frame's pose came from the network's detection


@dataclass
class _State:
    """State of a tracked part between two frames."""

    track: Track
    motion: Motion
    usual: float  # mean agreement with the image on the last frames
    unseen: int = 0  # frames since the part was lost
    doubts: int = 0  # frames in a row with less than the usual agreement
    disagreements: int = 0  # detections in a row that were elsewhere

    def move_to(self, detection: Detection) -> None:
        """Continue from a detection of the network, at rest."""
        self.track = Track(self.track.identity, detection, np.zeros(6), detected=True)
        self.motion = at_rest(detection.T_cam_obj, detection.covariance)
        self.unseen = self.doubts = self.disagreements = 0

    def follow(self, motion: Motion, detection: Detection) -> None:
        """Continue with a pose that was refined or predicted."""
        identity, self.motion = self.track.identity, motion
        self.track = Track(identity, detection, motion.velocity, detected=False)


class PoseTracker:
    """Tracks the parts of an estimator through the frames of one camera.

    Args:
        estimator: Estimator that refines poses on the image (``refine="region"``).
        detect_every: The network is run on every n-th frame even if all parts are tracked, to
            detect parts that have come into view.

    Raises:
        UserError: The estimator does not refine, or ``detect_every`` is below 1.
    """

    def __init__(self, estimator: PoseEstimator, detect_every: int = 30) -> None:
        if estimator.refiner is None:
            problem = "a tracker for an estimator without refinement"
            fix = "load it with PoseEstimator.load(path, refine='region')"
            raise UserError(problem, "refine='region'", fix)
        self.detect_every = check("detect_every", detect_every, int, Range(1, 1_000_000))
        self.estimator = estimator
        """Estimator, whose threshold may change between two frames."""
        self.weaker: list[float] = []
        """Scores below the threshold on the last frame, if the network was run on it."""
        self._cuboid_of = {part.name: part.cuboid for part in estimator.parts}
        self._diameters = {part.name: part.diameter for part in estimator.parts}
        self._states: list[_State] = []
        self._frame = 0
        self._identities = 0

    def track(self, image: RGBImage, K: CameraMatrix, cropped: bool = False) -> list[Track]:
        """Track and detect the parts on the next frame.

        Args:
            image: RGB, uint8, without lens distortion.
            K: Camera matrix, pixels.
            cropped: As in :meth:`PoseEstimator.predict`.

        Returns:
            Parts that are not lost and have at least the estimator's minimum score, by identity.

        Raises:
            UserError: The image is not an RGB image, or K does not belong to it.
        """
        image, K, _ = prepare_image(image, K, cropped=cropped)
        self.weaker = []
        for state in self._states:
            self._follow(state, image, K)
        doubtful = [state for state in self._states if self._is_doubtful(state)]
        is_due = self._frame % self.detect_every == 0
        if is_due or not self._states or any(state.unseen for state in doubtful):
            self._detect(image, K)
        elif doubtful:
            self._detect(image, K, _region_around([s.track.detection for s in doubtful], image))
        self._frame += 1
        self._states = [state for state in self._states if state.unseen <= FORGOTTEN]
        tracks = [state.track for state in self._states if not state.unseen]
        return [track for track in tracks if track.detection.score >= self.estimator.min_score]

    def _is_doubtful(self, state: _State) -> bool:
        """Return whether the network must search a part that is lost, uncertain or contradicted."""
        unsure = _agreement(state.track.detection) < SURE and self._frame % OFTEN == 0
        return bool(unsure or state.unseen or state.doubts or state.disagreements)

    def _follow(self, state: _State, image: RGBImage, K: CameraMatrix) -> None:
        """Refine a part's predicted pose; continue its motion if no pose is accepted."""
        previous, forecast = state.track.detection, state.motion.predict()
        rejected = None
        if not state.unseen and forecast.T_cam_obj[2, 3] > 0:
            for motion in (forecast, state.motion.predict(sudden=True)):
                covariance = motion.pose_covariance
                start = replace(previous, T_cam_obj=motion.T_cam_obj, covariance=covariance)
                refined = self.estimator.refined([start], image, K)[0]
                if refined.kept:
                    continue
                agreement = _agreement(refined)
                if agreement >= max(DOUBTFUL * state.usual, min(TRUSTED, state.usual)):
                    state.follow(motion.update(refined.T_cam_obj, refined.covariance), refined)
                    state.usual += USUAL * (agreement - state.usual)
                    state.doubts = 0
                    return
                rejected = rejected or replace(start, agreement=agreement)
        if rejected is None or state.doubts == PATIENCE:
            state.unseen += 1
            return
        keypoints = project_keypoints(self._cuboid_of[previous.object], forecast.T_cam_obj, K)
        state.follow(forecast, replace(rejected, keypoints=keypoints))
        state.doubts += 1

    def _detect(self, image: RGBImage, K: CameraMatrix, roi: Region | None = None) -> None:
        """Run the network, and assign its detections to tracked, lost and new parts."""
        candidates = self.estimator.candidates(image, K, roi=roi, cropped=True)  # checked before
        detections, self.weaker = self.estimator.split(candidates)
        refined = [detection for detection in detections if not detection.kept]
        for state, detection in self._assigned(refined):
            agreement = _agreement(detection)
            if state is None:
                track = Track(self._identities, detection, np.zeros(6), detected=True)
                motion = at_rest(detection.T_cam_obj, detection.covariance)
                self._states.append(_State(track, motion, agreement))
                self._identities += 1
                continue
            tracked = state.track.detection
            if agreement < min(TRUSTED, state.usual):
                continue
            if state.unseen or (state.doubts and agreement > _agreement(tracked)):
                state.move_to(detection)
            elif self._keypoint_distance(tracked, detection) <= ELSEWHERE:
                state.disagreements = 0
            elif agreement >= _agreement(tracked):
                state.disagreements += 1
                if state.disagreements == OUTVOTED:
                    state.move_to(detection)

    def _assigned(self, detections: Sequence[Detection]) -> list[tuple[_State | None, Detection]]:
        """Match detections to tracked, then to lost or doubtful parts; None marks a new part."""
        pairs: list[tuple[_State | None, Detection]] = []
        for name in self._cuboid_of:
            left = [detection for detection in detections if detection.object == name]
            states = [state for state in self._states if state.track.detection.object == name]
            for is_astray, limit in ((False, NEAR * self._diameters[name]), (True, math.inf)):
                chosen = [s for s in states if bool(s.unseen or s.doubts) == is_astray]
                tracked = np.reshape([_centre(s.track.detection) for s in chosen], (-1, 1, 3))
                detected = np.reshape([_centre(detection) for detection in left], (1, -1, 3))
                distances = np.linalg.norm(tracked - detected, axis=2)
                assigned = scipy.optimize.linear_sum_assignment(distances)
                near = [
                    (row, column)
                    for row, column in zip(*assigned, strict=True)
                    if distances[row, column] <= limit
                ]
                pairs += [(chosen[row], left[column]) for row, column in near]
                used = {column for _, column in near}
                left = [detection for number, detection in enumerate(left) if number not in used]
            pairs += [(None, detection) for detection in left]
        return pairs

    def _keypoint_distance(self, tracked: Detection, detection: Detection) -> float:
        """Return the mean distance between the keypoints at two poses, diameters."""
        cuboid = self._cuboid_of[tracked.object]
        first, second = (transform(pose.T_cam_obj, cuboid) for pose in (tracked, detection))
        distance = np.linalg.norm(first - second, axis=1).mean()
        return float(distance / self._diameters[tracked.object])


def _region_around(detections: Sequence[Detection], image: RGBImage) -> Region | None:
    """Return a region with a margin around detections; None if it is almost outside the image."""
    points = np.concatenate([detection.keypoints for detection in detections])
    margin = AROUND * max(np.ptp(detection.keypoints, axis=0).max() for detection in detections)
    limits = np.array(image.shape[1::-1])
    start = np.clip(np.floor(points.min(axis=0) - margin), 0, limits)
    end = np.clip(np.ceil(points.max(axis=0) + margin), 0, limits)
    if (end - start).min() < margin:
        return None
    (x, y), (width, height) = start.astype(int), (end - start).astype(int)
    return x, y, width, height


def _agreement(detection: Detection) -> float:
    """Return the agreement of a detection's outline, 0 if unknown."""
    return 0.0 if detection.agreement is None else detection.agreement


def _centre(detection: Detection) -> Float[np.ndarray, "3"]:
    """Return the position of a detection's origin in the camera frame, metres."""
    return detection.T_cam_obj[:3, 3]
