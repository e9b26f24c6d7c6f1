"""PoseTracker: tracks parts from frame to frame and runs the network only where necessary.

Refinement alone (:mod:`dopepp.inference.refinement.region`) searches a part of the last frame near
the pose that its motion predicts: first close to the prediction, then as far as a hand may have
moved the part. If neither pose is accepted, the network is run on the surroundings. If the network
does not detect the part either, the part is lost, and the network is run on every frame until the
part reappears, under the same identity.

A Kalman filter (:mod:`dopepp.inference.motion`) estimates pose and velocity of a part. To track by
other images than those of one camera, write a subclass of :class:`Tracker`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Generic, TypeVar

import numpy as np
import scipy  # SciPy loads its submodules on first use
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Step, Transform, project_keypoints, transform
from dopepp.inference.input_image import Region, prepare_image
from dopepp.inference.motion import Motion, at_rest
from dopepp.recovery.detection import Detection

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator

MARGIN: Final = 0.5  # margin around a doubtful part in which it is searched, share of its extent
MAX_SHIFT: Final = 0.5  # distance between the centres of a track and its detection, diameters
MAX_ERROR: Final = 0.1  # mean keypoint distance above which track and detection disagree, diameters
MAX_DISAGREEMENTS: Final = 2  # consecutive disagreeing detections after which a track moves to them
# Share of the usual agreement below which a track is doubtful. On rendered sequences, the share was
# 0.97 at correct poses, and 0.5 at poses that an occluder had displaced.
MIN_USUAL_SHARE: Final = 0.8
# Agreement below which a pose of a tracked part is rejected (unless the first pose agreed less):
# half of a wrong pose's outline may coincide with other edges.
MIN_AGREEMENT: Final = 0.6
CERTAIN: Final = 0.85  # agreement below which the network is run every CHECK_EVERY frames
CHECK_EVERY: Final = 5
USUAL_WEIGHT: Final = 0.1  # weight of a frame in the usual agreement
MAX_DOUBTS: Final = 6  # consecutive doubtful frames in which a part moves on before it is lost
MAX_UNSEEN: Final = 300  # frames after which a lost part is no longer searched

Item = TypeVar("Item")  # type of a detection: in a camera, or in the world


@dataclass(frozen=True, eq=False)
class Estimate(Generic[Item]):
    """Detection with its pose, covariance and agreement in the frame in which it is tracked."""

    detection: Item
    object: str  # name of the part
    score: float
    pose: Transform  # in the frame in which the part is tracked
    covariance: Float[np.ndarray, "6 6"]
    agreement: float  # agreement of the outline with the image, 0 if unknown


@dataclass(frozen=True)
class Track(Generic[Item]):
    """Pose and velocity of a tracked part in one frame."""

    identity: int  # number of the instance, kept while the part is tracked or lost
    detection: Item  # this frame's pose, with score and peaks of the network's last run
    velocity: Step  # per frame, as in :class:`.Motion`
    detected: bool  # whether this frame's pose came from the network's detection


@dataclass
class _State(Generic[Item]):
    """State of a tracked part between two frames."""

    identity: int
    estimate: Estimate[Item]
    motion: Motion
    usual: float  # mean agreement with the image on the last frames
    detected: bool = True  # whether the last pose came from the network's detection
    unseen: int = 0  # frames since the part was lost
    doubts: int = 0  # frames in a row with less than the usual agreement
    disagreements: int = 0  # detections in a row whose pose differs from the tracked pose

    def move_to(self, estimate: Estimate[Item], motion: Motion) -> None:
        """Continue from a detection of the network, at rest."""
        self.estimate, self.motion, self.detected = estimate, motion, True
        self.unseen = self.doubts = self.disagreements = 0

    def follow(self, motion: Motion, estimate: Estimate[Item]) -> None:
        """Continue with a pose that was refined or predicted."""
        self.estimate, self.motion, self.detected = estimate, motion, False

    def track(self) -> Track[Item]:
        """Return the part's pose and velocity in the last frame."""
        velocity = np.zeros(6) if self.detected else self.motion.velocity
        return Track(self.identity, self.estimate.detection, velocity, self.detected)


class Tracker(ABC, Generic[Item]):
    """Tracks the parts of an estimator from frame to frame; subclasses refine and detect.

    The network is run on every ``detect_every``-th frame even if all parts are tracked, to detect
    parts that have come into view.

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
        self._states: list[_State[Item]] = []
        self._frame = 0
        self._identities = 0

    @abstractmethod
    def _distance(self, pose: Transform) -> float:
        """Return the distance of a pose from the nearest camera, metres; negative if behind it."""

    @abstractmethod
    def _refined(self, estimate: Estimate[Item], forecast: Motion) -> Estimate[Item] | None:
        """Refine a predicted pose of a part on the frame; return None if the part is not there."""

    @abstractmethod
    def _moved(
        self, estimate: Estimate[Item], forecast: Motion, agreement: float
    ) -> Estimate[Item]:
        """Return a part at its predicted pose, with the ``agreement`` of the rejected pose."""

    @abstractmethod
    def _detected(self, near: Sequence[Estimate[Item]] | None) -> list[Estimate[Item]]:
        """Run the network on the frame, or only around parts; return refined detections."""

    def _advance(self) -> list[Track[Item]]:
        """Track and detect the parts on the next frame, which the subclass has stored.

        Returns:
            Parts that are not lost and have at least the estimator's minimum score, by identity.
        """
        self.weaker = []
        for state in self._states:
            self._follow(state)
        doubtful = [state for state in self._states if self._is_doubtful(state)]
        is_due = self._frame % self.detect_every == 0
        if is_due or not self._states or any(state.unseen for state in doubtful):
            self._detect(None)
        elif doubtful:
            self._detect([state.estimate for state in doubtful])
        self._frame += 1
        self._states = [state for state in self._states if state.unseen <= MAX_UNSEEN]
        least = self.estimator.min_score
        return [s.track() for s in self._states if not s.unseen and s.estimate.score >= least]

    def _is_doubtful(self, state: _State[Item]) -> bool:
        """Return whether the network must search a part that is lost, uncertain or contradicted."""
        unsure = state.estimate.agreement < CERTAIN and self._frame % CHECK_EVERY == 0
        return bool(unsure or state.unseen or state.doubts or state.disagreements)

    def _follow(self, state: _State[Item]) -> None:
        """Refine a part's predicted pose; continue its motion if no pose is accepted."""
        distance = self._distance(state.motion.T_cam_obj)
        forecast = state.motion.predict(distance)
        rejected: float | None = None
        if not state.unseen and self._distance(forecast.T_cam_obj) > 0:
            for motion in (forecast, state.motion.predict(distance, sudden=True)):
                refined = self._refined(state.estimate, motion)
                if refined is None:
                    continue
                agreement = refined.agreement
                if agreement >= max(MIN_USUAL_SHARE * state.usual, min(MIN_AGREEMENT, state.usual)):
                    state.follow(motion.update(refined.pose, refined.covariance), refined)
                    state.usual += USUAL_WEIGHT * (agreement - state.usual)
                    state.doubts = 0
                    return
                rejected = agreement if rejected is None else rejected
        if rejected is None or state.doubts == MAX_DOUBTS:
            state.unseen += 1
            return
        state.follow(forecast, self._moved(state.estimate, forecast, rejected))
        state.doubts += 1

    def _detect(self, near: Sequence[Estimate[Item]] | None) -> None:
        """Run the network, and assign its detections to tracked, lost and new parts."""
        for state, detected in self._assigned(self._detected(near)):
            motion = at_rest(detected.pose, detected.covariance, self._distance(detected.pose))
            if state is None:
                identity, self._identities = self._identities, self._identities + 1
                self._states.append(_State(identity, detected, motion, detected.agreement))
                continue
            tracked = state.estimate
            if state.unseen:
                state.move_to(detected, motion)
            elif detected.agreement < min(MIN_AGREEMENT, state.usual):
                continue
            elif state.doubts and detected.agreement > tracked.agreement:
                state.move_to(detected, motion)
            elif self._keypoint_distance(tracked, detected) <= MAX_ERROR:
                state.disagreements = 0
            elif detected.agreement >= tracked.agreement:
                state.disagreements += 1
                if state.disagreements == MAX_DISAGREEMENTS:
                    state.move_to(detected, motion)

    def _assigned(
        self, detections: Sequence[Estimate[Item]]
    ) -> list[tuple[_State[Item] | None, Estimate[Item]]]:
        """Match detections to tracked, then to lost or doubtful parts; None marks a new part."""
        pairs: list[tuple[_State[Item] | None, Estimate[Item]]] = []
        for name in self._cuboid_of:
            left = [detection for detection in detections if detection.object == name]
            states = [state for state in self._states if state.estimate.object == name]
            for is_astray, limit in ((False, MAX_SHIFT * self._diameters[name]), (True, math.inf)):
                chosen = [s for s in states if bool(s.unseen or s.doubts) == is_astray]
                tracked = np.reshape([s.estimate.pose[:3, 3] for s in chosen], (-1, 1, 3))
                detected = np.reshape([item.pose[:3, 3] for item in left], (1, -1, 3))
                distances = np.linalg.norm(tracked - detected, axis=2)
                assigned = scipy.optimize.linear_sum_assignment(distances)
                near = [pair for pair in zip(*assigned, strict=True) if distances[pair] <= limit]
                pairs += [(chosen[row], left[column]) for row, column in near]
                used = {column for _, column in near}
                left = [detection for number, detection in enumerate(left) if number not in used]
            pairs += [(None, detection) for detection in left]
        return pairs

    def _keypoint_distance(self, tracked: Estimate[Item], detected: Estimate[Item]) -> float:
        """Return the mean distance between the keypoints at two poses, diameters."""
        cuboid = self._cuboid_of[tracked.object]
        first, second = (transform(estimate.pose, cuboid) for estimate in (tracked, detected))
        distance = np.linalg.norm(first - second, axis=1).mean()
        return float(distance / self._diameters[tracked.object])


class PoseTracker(Tracker[Detection]):
    """Tracks the parts of an estimator through the frames of one camera; see :class:`Tracker`."""

    def track(
        self, image: RGBImage, K: CameraMatrix, cropped: bool = False
    ) -> list[Track[Detection]]:
        """Track and detect the parts on the next frame; for arguments, see `PoseEstimator.predict`.

        Returns:
            Parts that are not lost and have at least the estimator's minimum score, by identity.

        Raises:
            UserError: The image is not an RGB image, or K does not belong to it.
        """
        self._image, self._K, _ = prepare_image(image, K, cropped=cropped)
        return self._advance()

    def _distance(self, pose: Transform) -> float:
        return float(pose[2, 3])

    def _refined(
        self, estimate: Estimate[Detection], forecast: Motion
    ) -> Estimate[Detection] | None:
        start = _forecast(estimate, forecast)
        refined = self.estimator.refined([start], self._image, self._K, followed=True)[0]
        return None if refined.kept else _estimate(refined)

    def _moved(
        self, estimate: Estimate[Detection], forecast: Motion, agreement: float
    ) -> Estimate[Detection]:
        moved = _forecast(estimate, forecast)
        keypoints = project_keypoints(self._cuboid_of[estimate.object], moved.T_cam_obj, self._K)
        return _estimate(replace(moved, keypoints=keypoints, agreement=agreement))

    def _detected(self, near: Sequence[Estimate[Detection]] | None) -> list[Estimate[Detection]]:
        roi = None
        if near is not None:
            roi = region_around([item.detection for item in near], self._image)
        candidates = self.estimator.candidates(self._image, self._K, roi=roi, cropped=True)
        detections, self.weaker = self.estimator.split(candidates)
        return [_estimate(detection) for detection in detections if not detection.kept]


def _forecast(estimate: Estimate[Detection], forecast: Motion) -> Detection:
    """Return a part's detection at its predicted pose."""
    pose, covariance = forecast.T_cam_obj, forecast.pose_covariance
    return replace(estimate.detection, T_cam_obj=pose, covariance=covariance)


def _estimate(detection: Detection) -> Estimate[Detection]:
    """Return a detection in a camera as an estimate."""
    given = detection, detection.object, detection.score
    pose, covariance = detection.T_cam_obj, detection.covariance
    return Estimate(*given, pose, covariance, detection.agreement or 0.0)


def region_around(detections: Sequence[Detection], image: RGBImage) -> Region | None:
    """Return a region with a margin around detections; None if it is almost outside the image."""
    points = np.concatenate([detection.keypoints for detection in detections])
    margin = MARGIN * max(np.ptp(detection.keypoints, axis=0).max() for detection in detections)
    limits = np.array(image.shape[1::-1])
    start = np.clip(np.floor(points.min(axis=0) - margin), 0, limits)
    end = np.clip(np.ceil(points.max(axis=0) + margin), 0, limits)
    if (end - start).min() < margin:
        return None
    (x, y), (width, height) = start.astype(int), (end - start).astype(int)
    return x, y, width, height
