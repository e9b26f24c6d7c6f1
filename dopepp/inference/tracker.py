"""PoseTracker: parts followed from frame to frame; the network runs only where it must.

A part that was seen in the last frame is looked for where its motion takes it, by refinement alone
(:mod:`dopepp.inference.refinement.region`): first near there, then as far as a hand may have moved
it. Where neither is believed, the network looks; where it finds nothing either, the part is lost,
and the network looks in every frame until it is there again, under the same identity.

A part's motion is a Kalman filter over its pose and its velocity. Each frame's pose comes with a
covariance in which the filter's own forecast is contained already (it was the refinement's prior),
so the velocity follows from what the pose has been corrected by: a pose that is still being
corrected is not taken for one that moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
import scipy  # its parts load when they are used
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import (
    CameraMatrix,
    Step,
    Transform,
    moved,
    project_keypoints,
    step_between,
    transform,
)
from dopepp.inference.picture import Region, prepare_image
from dopepp.recovery.detection import Detection

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator

AROUND: Final = 0.5
"""Of a part's extent on the picture, beyond it: where the network looks for one in doubt."""

NEAR: Final = 0.5
"""Diameters between the centres of a track and a detection that may be the same part."""

ELSEWHERE: Final = 0.1
"""Diameters, of mean distance between keypoints: farther apart, track and detection disagree."""

OUTVOTED: Final = 2  # detections in a row that disagree with a track before it is moved to them

DOUBTFUL: Final = 0.8
"""Share of its usual agreement below which a track may have been drawn away by what hides it: on
rendered sequences, right poses kept 0.97 of it and wrong ones half."""

TRUSTED: Final = 0.6
"""Agreement below which no pose is taken over, except the first: half of a wrong one's outline may
lie on edges of something else."""

SURE: Final = 0.85
OFTEN: Final = 5  # agreement below which the network looks at every so manieth frame
USUAL: Final = 0.1  # weight of a frame in the usual agreement

PATIENCE: Final = 6
"""Doubtful frames in a row, in which a part goes on as it was going, before it is lost."""

FORGOTTEN: Final = 300  # frames after which a lost part is no longer looked for


STILL: Final = (math.radians(0.05), 2e-4)
"""Standard deviations of how much the velocity of a part at rest may change in a frame: radians
along each axis, and metres per metre of its distance. The smaller, the less it trembles."""

SUDDEN: Final = (math.radians(4.0), 0.025)
"""The same of a part that a hand takes up or turns round: half of 8° and of 5 % a frame."""

SWERVE: Final = 0.6
"""Share of its speed, and of what the last frame has corrected, that may come on top of it."""

PERSISTENCE: Final = 0.95  # share of the velocity that is left after a frame


@dataclass(frozen=True, eq=False)
class Motion:
    """A part's pose and velocity."""

    T_cam_obj: Transform  # the pose
    # A frame's turn (rotation vector, radians) about the object's origin, and its shift
    # (metres), both in camera axes
    velocity: Step
    covariance: Float[np.ndarray, "12 12"]  # of pose and velocity, in the same six numbers each
    correction: Step  # by which the last frame has moved the forecast

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of the pose alone."""
        return self.covariance[:6, :6]

    def ahead(self, sudden: bool = False) -> Motion:
        """Return the next frame's forecast; ``sudden``: something may have happened."""
        change = self._change(sudden) ** 2
        step = np.eye(12)
        step[:6, 6:] = step[6:, 6:] = PERSISTENCE * np.eye(6)
        added = np.kron([[1.0, 1.0], [1.0, 1.0]], np.diag(change))
        return Motion(
            moved(self.T_cam_obj, PERSISTENCE * self.velocity),
            PERSISTENCE * self.velocity,
            step @ self.covariance @ step.T + added,
            self.correction,
        )

    def seen(self, T_cam_obj: Transform, covariance: Float[np.ndarray, "6 6"]) -> Motion:
        """Return this forecast with a frame's pose, and its covariance, which contains it."""
        correction = step_between(self.T_cam_obj, T_cam_obj)
        pose = self.pose_covariance
        gain = self.covariance[:, :6] @ np.linalg.inv(pose)
        velocity = self.velocity + gain[6:] @ correction
        whole = self.covariance - gain @ (pose - covariance) @ gain.T
        return Motion(T_cam_obj, velocity, whole, correction)

    def _change(self, sudden: bool) -> Step:
        """Return the deviations of the velocity's change."""
        least = SUDDEN if sudden else STILL
        deviations = []
        for number, unit in enumerate((1.0, float(self.T_cam_obj[2, 3]))):
            own = slice(3 * number, 3 * number + 3)
            speeds = np.linalg.norm(self.velocity[own]), np.linalg.norm(self.correction[own])
            deviations.append(max(least[number] * unit, SWERVE / math.sqrt(3) * float(sum(speeds))))
        return np.repeat(deviations, 3)


def at_rest(T_cam_obj: Transform, covariance: Float[np.ndarray, "6 6"]) -> Motion:
    """Return the motion of a part that was seen once: whether it moves is not known."""
    whole = np.zeros((12, 12))
    whole[:6, :6] = covariance
    turn, shift = SUDDEN
    whole[6:, 6:] = np.diag(np.repeat([turn, shift * float(T_cam_obj[2, 3])], 3) ** 2)
    return Motion(T_cam_obj, np.zeros(6), whole, np.zeros(6))


@dataclass(frozen=True)
class Track:
    """A part that was found on a frame."""

    # Of this instance, the same as long as it is followed, and when it is found again
    identity: int
    # Its pose, keypoints and covariance on this frame; score and peaks are those of the
    # network's last look
    detection: Detection
    # Its motion a frame, camera axes: a turn (rotation vector, radians) about the object's
    # origin, and a shift (metres)
    velocity: Step
    detected: bool  # whether this frame's pose came from the network's detection


@dataclass
class _State:
    """What is known of a part between two frames.

    ``usual`` is its agreement with the picture on late frames. ``unseen`` counts the frames since
    it was last seen, ``doubts`` those in which it agreed less than usual, and ``disagreements`` the
    network's answers in a row that were elsewhere.
    """

    track: Track
    motion: Motion
    usual: float
    unseen: int = 0
    doubts: int = 0
    disagreements: int = 0

    def move_to(self, one: Detection) -> None:
        """Go on from where the network has found the part."""
        self.track = Track(self.track.identity, one, np.zeros(6), detected=True)
        self.motion = at_rest(one.T_cam_obj, one.covariance)
        self.unseen = self.doubts = self.disagreements = 0


class PoseTracker:
    """Follows the parts of an estimator through the frames of one camera.

    Args:
        estimator: One that refines poses on the picture (``refine="region"``).
        detect_every: The network looks at every so manieth frame even where all parts are followed,
            for parts that have come into view.

    Raises:
        UserError: The estimator does not refine, or ``detect_every`` is below 1.
    """

    def __init__(self, estimator: PoseEstimator, detect_every: int = 30) -> None:
        if estimator.refiner is None:
            raise UserError(
                "a tracker of an estimator that does not refine", "refine='region'",
                "load it with PoseEstimator.load(path, refine='region')",
            )  # fmt: skip
        self.detect_every = check("detect_every", detect_every, int, Range(1, 1_000_000))
        self._estimator = estimator
        self._cuboid_of = {part.name: part.cuboid for part in estimator.parts}
        self._diameters = {part.name: part.diameter for part in estimator.parts}
        self._states: list[_State] = []
        self._frame = 0
        self._identities = 0

    def track(self, image: Picture, K: CameraMatrix, cropped: bool = False) -> list[Track]:
        """Find the parts on the next frame.

        Args:
            image: RGB, uint8, without lens distortion.
            K: Camera matrix, pixels.
            cropped: As :meth:`PoseEstimator.predict` takes it.

        Returns:
            The parts that were found, in the order of their identities.

        Raises:
            UserError: The image is no RGB picture, or K cannot belong to it.
        """
        image, K, _ = prepare_image(image, K, cropped=cropped)
        for state in self._states:
            self._follow(state, image, K)
        due = self._frame % self.detect_every == 0
        asked = [one for one in self._states if self._is_asked(one)]
        if due or not self._states or any(one.unseen for one in asked):
            self._look(image, K)
        elif asked:
            self._look(image, K, _around([one.track.detection for one in asked], image))
        self._frame += 1
        self._states = [one for one in self._states if one.unseen <= FORGOTTEN]
        return [one.track for one in self._states if not one.unseen]

    def _is_asked(self, state: _State) -> bool:
        """Tell whether the network is to look for a part on this frame."""
        unsure = _agreement(state.track.detection) < SURE and self._frame % OFTEN == 0
        return bool(unsure or state.unseen or state.doubts or state.disagreements)

    def _follow(self, state: _State, image: Picture, K: CameraMatrix) -> None:
        """Look for a part where its motion takes it."""
        old = state.track.detection
        forecast = state.motion.ahead()
        doubtful = None
        if not state.unseen and forecast.T_cam_obj[2, 3] > 0:
            for expected in (forecast, state.motion.ahead(sudden=True)):
                given = replace(
                    old, T_cam_obj=expected.T_cam_obj, covariance=expected.pose_covariance
                )
                found = self._estimator.refined([given], image, K)[0]
                if found.kept:
                    continue
                agreement = _agreement(found)
                if agreement >= max(DOUBTFUL * state.usual, min(TRUSTED, state.usual)):
                    state.motion = expected.seen(found.T_cam_obj, found.covariance)
                    state.track = replace(
                        state.track, detection=found, velocity=state.motion.velocity, detected=False
                    )
                    state.usual += USUAL * (agreement - state.usual)
                    state.doubts = 0
                    return
                doubtful = doubtful or replace(given, agreement=agreement)
        if doubtful is None or state.doubts == PATIENCE:
            state.unseen += 1
            return
        keypoints = project_keypoints(self._cuboid_of[old.object], forecast.T_cam_obj, K)
        doubtful = replace(doubtful, keypoints=keypoints)
        state.motion = forecast
        state.track = replace(
            state.track, detection=doubtful, velocity=forecast.velocity, detected=False
        )
        state.doubts += 1

    def _look(self, image: Picture, K: CameraMatrix, roi: Region | None = None) -> None:
        """Let the network look, and tell known parts from new ones."""
        found = self._estimator.predict(image, K, roi=roi, cropped=True)  # checked before
        found = [one for one in found if not one.kept]
        for state, one in self._matched(found):
            if state is None:
                track = Track(self._identities, one, np.zeros(6), detected=True)
                motion = at_rest(one.T_cam_obj, one.covariance)
                self._states.append(_State(track, motion, _agreement(one)))
                self._identities += 1
            elif _agreement(one) < min(TRUSTED, state.usual):
                continue
            elif state.unseen or (
                state.doubts and _agreement(one) > _agreement(state.track.detection)
            ):
                state.move_to(one)
            elif self._apart(state.track.detection, one) <= ELSEWHERE:
                state.disagreements = 0
            elif _agreement(one) >= _agreement(state.track.detection):
                state.disagreements += 1
                if state.disagreements == OUTVOTED:
                    state.move_to(one)

    def _matched(self, found: Sequence[Detection]) -> list[tuple[_State | None, Detection]]:
        """Pair detections with the parts they show: first those followed, then lost or in doubt."""
        pairs: list[tuple[_State | None, Detection]] = []
        for name in self._cuboid_of:
            left = [one for one in found if one.object == name]
            own = [one for one in self._states if one.track.detection.object == name]
            for astray, limit in ((False, NEAR * self._diameters[name]), (True, math.inf)):
                states = [one for one in own if bool(one.unseen or one.doubts) == astray]
                distances = np.array(
                    [[_distance(one.track.detection, other) for other in left] for one in states]
                ).reshape(len(states), len(left))
                taken = set()
                assigned = scipy.optimize.linear_sum_assignment(distances)
                for row, column in zip(*assigned, strict=True):
                    if distances[row, column] <= limit:
                        pairs.append((states[row], left[column]))
                        taken.add(column)
                left = [one for number, one in enumerate(left) if number not in taken]
            pairs += [(None, one) for one in left]
        return pairs

    def _apart(self, one: Detection, other: Detection) -> float:
        """Return the mean distance between the cuboids' corners, diameters."""
        cuboid = self._cuboid_of[one.object]
        first, second = (transform(pose.T_cam_obj, cuboid) for pose in (one, other))
        apart = np.linalg.norm(first - second, axis=1).mean()
        return float(apart / self._diameters[one.object])


def _around(found: Sequence[Detection], image: Picture) -> Region | None:
    """Return the region in which parts may be that were there; None is the whole image."""
    points = np.concatenate([one.keypoints for one in found])
    reach = AROUND * max(np.ptp(one.keypoints, axis=0).max() for one in found)
    limits = np.array(image.shape[1::-1])
    start = np.clip(np.floor(points.min(axis=0) - reach), 0, limits)
    end = np.clip(np.ceil(points.max(axis=0) + reach), 0, limits)
    if (end - start).min() < reach:  # hardly in view
        return None
    (x, y), (width, height) = start.astype(int), (end - start).astype(int)
    return x, y, width, height


def _agreement(one: Detection) -> float:
    return 0.0 if one.agreement is None else one.agreement


def _distance(one: Detection, other: Detection) -> float:
    return float(np.linalg.norm(one.T_cam_obj[:3, 3] - other.T_cam_obj[:3, 3]))
