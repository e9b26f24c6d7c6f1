"""Diagnosis of missing or bad poses: one sentence and one fix per check.

Parts are detected as by :meth:`PoseEstimator.predict` and in further image sizes, and detections
are compared with the outlines on the image. Checks of causes come first: a wrong mesh or a
blurred image affects all later checks. Thresholds were measured on rendered images with known
faults (``benchmarks/doctor.py``).

To add a check, write a function from a :class:`Case` to a :class:`Diagnosis` and insert it into
:data:`CHECKS` before the checks whose failures it explains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from dopepp.geometry.camera import Letterbox, focal_length
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.focal import focal_factor
from dopepp.inference.diagnosis.case import (
    Case,
    clipped_share,
    edge_width,
    highlights,
    num_keypoints,
)
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.network_input import MARGIN
from dopepp.parts.part import UNITS
from dopepp.parts.size import is_plausible, size_in_words

__all__ = ["CHECKS", "Case", "Diagnosis", "diagnose"]

MAX_RATIO: Final = 1.05  # ratio of two sizes of a part that simplification of its mesh may cause
# Grey level (0 to 255) of highlights below which an image is dark: above 105 in good renders, 35 to
# 60 at 1/16 of the light.
MIN_HIGHLIGHT: Final = 70.0

# Shares of white pixels above which the image, or the region of the part, is overexposed: up to 0.1
# in good renders, 0.2 to 0.8 with eight times the light.
CLIPPED, CLIPPED_PART = 0.25, 0.15

# Width of edges above which an image is blurred, pixels of the network's input. A blur of two
# pixels (1.1 to 2) is harmless. At a blur of five (3.2 to 4.7), a quarter of the parts is missed.
MAX_EDGE_WIDTH: Final = 2.5

# K is reported as wrong if a focal length that differs by the factor FOCAL reduces the robust
# squared error of the keypoints by the factor GAIN, and the standard deviation of its logarithm is
# below CERTAIN. The factor is 0.9 to 2.3 if K is correct. If the focal length is wrong by a factor
# of 2, the factor is 3 to 20 on a third of the images.
FOCAL, GAIN, CERTAIN = 1.35, 3.0, 0.2

# Belief at a part's centre from which the part is partly visible: 0.4 to 0.8 for half-occluded
# parts, mostly below 0.2 on images without the part.
MIN_BELIEF: Final = 0.3
MIN_SCORE: Final = 0.03  # of a correct detection; untuned networks' false positives score lower
MAX_ERROR: Final = 0.08  # reprojection error, share of the part's length: up to 0.06 if good
MIN_AGREEMENT: Final = 0.6  # smallest share of the outline that agrees: 0.68 to 1 in good renders

ABSENT: Final = (
    "check that the part is on the image, uncovered, and shows a side that training images showed; "
    "otherwise train with its materials, light and backgrounds"
)
TUNE: Final = (
    "tune with images that do not show the part: python evaluate.py ckpt_path=MODEL tune=true "
    "virtual.negative_photos=FOLDER"
)


@dataclass(frozen=True)
class Diagnosis:
    """Result of a check: an observation and its remedy."""

    subject: str  # part, exposure, sharpness, camera, size, visibility, elsewhere or pose
    sentence: str  # observation
    fix: str = ""  # remedy; empty if all is well

    def __str__(self) -> str:
        return f"{self.subject}: {self.sentence}" + (f"; fix: {self.fix}" if self.fix else "")


def part_size(case: Case) -> Diagnosis:
    """Check whether the parts' sizes are plausible and the meshes have the trained size."""
    sizes = []
    for part, given in zip(case.estimator.parts, case.parts, strict=True):
        learned = np.ptp(part.cuboid, axis=0)
        sizes.append(f"{part.name} measures {size_in_words(learned)}")
        if given.mesh is not None:
            extents = np.ptp(given.mesh.vertices, axis=0)
            ratio = float(np.linalg.norm(extents) / np.linalg.norm(learned))
            if not _near(ratio, MAX_RATIO):
                mesh = f"its mesh {size_in_words(extents)}, {ratio:.3g} times that"
                return Diagnosis("part", f"{sizes[-1]}, and {mesh}", _unit_fix(ratio))
        if not is_plausible(part):
            fix = "pass the unit of the mesh's file: --unit mm, cm, m or inch"
            if isinstance(case.estimator, NetworkEstimator):
                fix = "train again with the unit of the mesh's file: data.unit=mm, cm, m or inch"
            return Diagnosis("part", f"{sizes[-1]}, which is unlikely", fix)
    return Diagnosis("part", "; ".join(sizes))


def exposure(case: Case) -> Diagnosis:
    """Check whether the image is dark, or overexposed at the part."""
    brightest, white, near = highlights(case.image), clipped_share(case.image), 0.0
    sentence = f"highlights of {brightest:.0f} of 255, {white:.0%} white without detail"
    if case.detection is not None:
        near = clipped_share(case.around())
        sentence += f", {near:.0%} around the part"
    if brightest < MIN_HIGHLIGHT:
        return Diagnosis("exposure", f"too dark: {sentence}", "expose longer, or add light")
    if white > CLIPPED or near > CLIPPED_PART:
        return Diagnosis("exposure", f"too bright: {sentence}", "expose less, or reduce the light")
    return Diagnosis("exposure", sentence)


def sharpness(case: Case) -> Diagnosis:
    """Check whether edges are sharp after the image is resized to the detector's input."""
    width = edge_width(case.around())
    if width is None:
        return Diagnosis("sharpness", "too few edges to measure the sharpness")
    size = f"{case.box.width}×{case.box.height}"
    width_image = width / case.box.scale_x
    owner = "network's" if isinstance(case.estimator, NetworkEstimator) else "templates'"
    sentence = f"edges {width_image:.1f} pixels wide, {width:.1f} in the {owner} {size}"
    if width <= MAX_EDGE_WIDTH:
        return Diagnosis("sharpness", sentence)
    fix = "focus on the part; if it or the camera moves, use a shorter exposure"
    return Diagnosis("sharpness", f"blurred: {sentence}", fix)


def camera(case: Case) -> Diagnosis:
    """Check K's focal length against the perspective of the part's keypoints and its distance."""
    half = np.array([case.image.shape[1], case.image.shape[0]]) / 2
    across, down = np.degrees(2 * np.arctan(half / case.K.diagonal()[:2]))
    sentence = f"K sees {across:.0f}° × {down:.0f}°"
    if case.detection is None:
        return Diagnosis("camera", sentence)
    fix = "check K: its image size (--K-size), the crop (--crop), the calibration"
    detection, name = case.detection, case.part.name
    lens = focal_factor(case.part.cuboid, detection.peaks, detection.T_cam_obj, case.K)
    if lens and lens.gain > GAIN and lens.deviation < CERTAIN and not _near(lens.factor, FOCAL):
        other = f"{name} has the perspective of a focal length {lens.factor:.2g} times K's"
        return Diagnosis("camera", f"{sentence}, but {other}", fix)
    ratio = _lens_ratio(case)
    if ratio is not None:
        other = f"{name} is as large as in training, but K puts it {ratio:.2g} times as far away"
        same = f"none if the focal length is {ratio:.2g} times the training focal length"
        fix = f"{same}; otherwise {fix}"
        return Diagnosis("camera", f"{sentence}; {other}", fix)
    return Diagnosis("camera", sentence)


def size(case: Case) -> Diagnosis:
    """Check whether the part's distance and size lie within the training range."""
    name, depths = case.part.name, case.estimator.depth_range(case.part.name)
    if depths is None:
        return Diagnosis("size", f"the checkpoint does not record the trained sizes of {name}")
    near, far = case.distances or depths
    trained = f"{near:.2g} – {far:.2g} m"
    if case.detection is None:
        return Diagnosis("size", f"{name} was searched at {trained}, and nearer and farther")
    z = float(case.detection.T_cam_obj[2, 3])
    sentence = f"{name} is {case.length_px:.0f} pixels long at {z:.3g} m"
    if case.outside_range is None:
        return Diagnosis("size", f"{sentence}; it is searched at {trained}")
    fix = f"move it to {trained}, or search there: --distance {0.9 * z:.2g} {1.1 * z:.2g}"
    if not _near(z / math.sqrt(near * far), 5):
        fix += "; the cause may also be a wrong unit of the part's mesh or of a distance"
    return Diagnosis("size", f"{sentence}, and nothing is found at {trained}", fix)


def visibility(case: Case) -> Diagnosis:
    """Check how many keypoints of the part the network detects."""
    name = case.part.name
    if not isinstance(case.estimator, NetworkEstimator):
        if case.detection is not None:
            return Diagnosis("visibility", f"{name} is detected, score {case.detection.score:.2g}")
        problem = f"no pose of {name} passes the verification"
        fix = "check that all of it is on the image and uncovered; add light from the side, or "
        fix += "train it (experiment=my_part): a network sees more in clutter"
        return Diagnosis("visibility", problem, fix)
    if case.detection is not None:
        count, score = num_keypoints(case.detection), case.detection.score
        sentence = f"{count} of 9 keypoints of {name}, score {score:.2g}"
        if score >= MIN_SCORE:
            return Diagnosis("visibility", sentence)
        problem = f"the best candidate is probably not {name}: {sentence}"
        return Diagnosis("visibility", problem, ABSENT)
    beliefs = case.strongest_beliefs()
    centre, count = float(beliefs[CENTROID]), int((beliefs > MIN_BELIEF).sum())
    if centre < MIN_BELIEF:
        belief = f"the belief of its centre is {centre:.2g} at most"
        return Diagnosis("visibility", f"{name} is not detected, {belief}", ABSENT)
    return Diagnosis(
        "visibility",
        f"{name} is only partly visible: a belief of {centre:.2g} in its centre and {count} of 9 "
        "keypoints, which determine no reliable pose",
        "uncover it, and keep all of it within the image, not nearer than in training",
    )


def elsewhere(case: Case) -> Diagnosis:
    """Check for detections away from the part centres that the user specified."""
    if case.centres is None:
        return Diagnosis(
            "elsewhere", "not checked, because neither --at nor --empty states where the parts are"
        )
    if not case.unexpected:
        return Diagnosis("elsewhere", "no detections away from the parts")
    best, threshold = case.unexpected[0], case.estimator.min_score
    u, v = best.keypoints[CENTROID]
    where = "away from every part" if case.centres else "on an image without the part"
    counts = f"{len(case.unexpected)} of {len(case.reported)} detections"
    counts += f" above {threshold:.2g} are {where}"
    best_score = f"the best has the score {best.score:.2g}, at ({u:.0f}, {v:.0f})"
    is_trained = isinstance(case.estimator, NetworkEstimator)
    fix = TUNE if is_trained else "raise the threshold: --conf, or train the part"
    return Diagnosis("elsewhere", f"{counts}; {best_score}", fix)


def pose(case: Case) -> Diagnosis:
    """Check whether keypoints and outline agree with the pose."""
    if case.detection is None:
        return Diagnosis("pose", "no pose to check")
    detection, refined, name = case.detection, case.refined, case.part.name
    share = detection.reprojection_error_px / case.length_px
    sentence = f"{name} has a reprojection error of {detection.reprojection_error_px:.1f} pixels"
    if not isinstance(case.estimator, NetworkEstimator):
        sentence = f"{name} is {case.length_px:.0f} pixels long"
    if share > MAX_ERROR:
        fix = "check K and the mesh; if both are correct, train longer or with more such images"
        return Diagnosis("pose", f"{sentence}, {share:.0%} of its length", fix)
    if refined is None:
        return Diagnosis("pose", f"{sentence}; without a mesh its outline is not checked")
    if refined.agreement is None:
        fix = "change the background or the light; check that the mesh is this part's (--part)"
        sentence += f", its outline does not determine a pose: {refined.kept}"
        return Diagnosis("pose", sentence, fix if case.estimator.refiner is not None else "")
    sentence += f", {refined.agreement:.0%} of its outline agrees"
    fix = "uncover the part; check that the mesh is this part's (--part)"
    return Diagnosis("pose", sentence, "" if refined.agreement >= MIN_AGREEMENT else fix)


# Faults that a check finds may also explain the failures of later checks.
CHECKS: Final = (part_size, exposure, sharpness, camera, size, visibility, elsewhere, pose)
EMPTY_CHECKS: Final = (part_size, elsewhere)  # of an image without parts: detections are false


def diagnose(case: Case) -> list[Diagnosis]:
    """Return the results of :data:`CHECKS`; of :data:`EMPTY_CHECKS` if ``centres`` is empty."""
    is_empty = case.centres is not None and not case.centres
    return [check(case) for check in (EMPTY_CHECKS if is_empty else CHECKS)]


def _lens_ratio(case: Case) -> float | None:
    """Return the ratio of K's and training's focal lengths if it explains a wrong distance.

    None if the part's distance is in the training range, if its size in pixels is outside the
    training range, or if the focal lengths hardly differ.
    """
    if case.seen is None or case.distances is not None or case.detection is None:
        return None
    assert isinstance(case.estimator, NetworkEstimator)  # templates have learned no range
    learned = Letterbox.fit(case.image.shape[1::-1], case.estimator.checkpoint.input_size)
    length, z = case.length_px * learned.scale_x, float(case.detection.T_cam_obj[2, 3])
    smallest, largest, near, far = case.seen
    if near / MARGIN < z < far * MARGIN or not smallest / MARGIN < length < largest * MARGIN:
        return None
    ratio = focal_length(case.K) * learned.scale_x * case.part.diameter / (smallest * far)
    return None if _near(ratio, FOCAL) else ratio


def _near(ratio: float, factor: float) -> bool:
    """Return whether a ratio differs from 1 by less than a factor."""
    return 1 / factor < ratio < factor


def _unit_fix(ratio: float) -> str:
    """Return the remedy for a mesh that is too large by a ratio, e.g. the ratio of two units."""
    for read, metres in UNITS.items():
        for actual, actual_metres in UNITS.items():
            if read != actual and _near(ratio * actual_metres / metres, MAX_RATIO):
                return f"it was read in {read} and is in {actual}: --unit {actual}"
    return "pass the mesh of the trained part: --part"
