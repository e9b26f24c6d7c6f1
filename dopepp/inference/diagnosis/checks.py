"""The checks of a case, each of which returns a finding.

The thresholds are what rendered pictures with known faults say (``benchmarks/doctor.py``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from dopepp.geometry.camera import Letterbox, focal_length
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.focal import focal_factor
from dopepp.inference.diagnosis.case import Case, clipped, edge_width, highlights, num_keypoints
from dopepp.inference.picture import MARGIN
from dopepp.parts.part import UNITS
from dopepp.parts.size import is_plausible, size_in_words

SAME: Final = 1.05  # factor on a part's size that a lighter mesh may have

DARK: Final = 70.0
"""Highlights, of 255: good renders' are 106 and more, those of a 16th of the light 35 to 60."""

CLIPPED, CLIPPED_PART = 0.25, 0.15
"""Shares of white in a picture and around the part: good renders have up to 0.1, those of eight
times the light 0.2 to 0.8."""

BLURRED: Final = 2.5
"""Width of edges, pixels of the network's picture: a blur of two pixels measures 1.1 to 2 and costs
nothing, one of five 3.2 to 4.7 and a quarter of the parts."""

FOCAL, GAIN, CERTAIN = 1.35, 3.0, 0.2
"""Factor on a focal length, how many times as well the keypoints must fit with it, and the largest
standard deviation of its logarithm, from which K is doubted. With the right K the gain is 0.9 to
2.3, with one twice or half as long 3 to 20 on a third of the pictures."""

PARTLY: Final = 0.3
"""Belief of a centre: half covered parts have 0.4 to 0.8, pictures without it mostly below 0.2."""

LEAST_SCORE: Final = 0.03
"""Of a part that is found: where a network is not tuned for silence, ghosts have less."""

OFF: Final = 0.08
"""Reprojection error, share of the part's length on the picture: good poses have up to 0.06."""

AGREEING: Final = 0.6  # share of the outline that agrees: good renders have 0.68 to 1

ABSENT: Final = (
    "see that it is on the picture, uncovered, with a side that training showed; else its look "
    "differs from training's: train with such materials, light and backgrounds"
)


@dataclass(frozen=True)
class Finding:
    """What was looked at, and what was seen."""

    subject: str  # one of part, exposure, sharpness, camera, size, visibility and pose
    sentence: str  # what was seen
    fix: str = ""  # what to do about it; empty where all is well

    def __str__(self) -> str:
        return f"{self.subject}: {self.sentence}" + (f"; fix: {self.fix}" if self.fix else "")


def part_size(case: Case) -> Finding:
    """See whether the parts can be as large as the network takes them to be."""
    words = []
    for part, given in zip(case.estimator.parts, case.parts, strict=True):
        learned = np.ptp(part.cuboid, axis=0)
        words.append(f"{part.name} measures {size_in_words(learned)}")
        if given.mesh is not None:
            own = np.ptp(given.mesh.vertices, axis=0)
            ratio = float(np.linalg.norm(own) / np.linalg.norm(learned))
            if not 1 / SAME < ratio < SAME:
                sentence = f"{words[-1]}, and its mesh {size_in_words(own)}, {ratio:.3g} times that"
                return Finding("part", sentence, _unit_fix(ratio))
        if not is_plausible(part):
            fix = "train again with the unit of the mesh's file: data.unit=mm, cm, m or inch"
            return Finding("part", f"{words[-1]}, which is unlikely", fix)
    return Finding("part", "; ".join(words))


def exposure(case: Case) -> Finding:
    """See whether the picture is dark, or white where the part should be."""
    brightest, white, near = highlights(case.image), clipped(case.image), 0.0
    sentence = f"highlights of {brightest:.0f} of 255, {white:.0%} white without detail"
    if case.found is not None:
        near = clipped(case.around())
        sentence += f", {near:.0%} around the part"
    if brightest < DARK:
        return Finding("exposure", f"too dark: {sentence}", "expose longer, or add light")
    if white > CLIPPED or near > CLIPPED_PART:
        return Finding("exposure", f"too bright: {sentence}", "expose less, or take light away")
    return Finding("exposure", sentence)


def sharpness(case: Case) -> Finding:
    """See whether edges are sharp in the size in which the network sees them."""
    width = edge_width(case.around())
    if width is None:
        return Finding("sharpness", "too few edges to tell")
    size = f"{case.box.width}×{case.box.height}"
    own = width / case.box.scale_x
    sentence = f"edges {own:.1f} pixels wide, {width:.1f} in the network's {size}"
    if width <= BLURRED:
        return Finding("sharpness", sentence)
    fix = "focus on the part; where it or the camera moves, expose for a shorter time"
    return Finding("sharpness", f"blurred: {sentence}", fix)


def camera(case: Case) -> Finding:
    """See whether K fits the part's perspective and the distance that follows from it."""
    half = np.array([case.image.shape[1], case.image.shape[0]]) / 2
    across, down = np.degrees(2 * np.arctan(half / case.K.diagonal()[:2]))
    sentence = f"K sees {across:.0f}° × {down:.0f}°"
    fix = "check K: its size (--K-size), what was cut out (--crop), its calibration"
    if case.found is None:
        return Finding("camera", sentence)
    one, name = case.found, case.part.name
    lens = focal_factor(case.part.cuboid, one.peaks, one.T_cam_obj, case.K)
    if lens and lens.gain > GAIN and lens.deviation < CERTAIN and not _near(lens.factor, FOCAL):
        other = f"{name} is seen in the perspective of a focal length {lens.factor:.2g} times K's"
        return Finding("camera", f"{sentence}, but {other}", fix)
    ratio = _lens_ratio(case)
    if ratio is not None:
        other = f"{name} looks as large as in training, and is {ratio:.2g} times as far away by K"
        fix = f"right if the lens is {ratio:.2g} times as long as training's; else {fix}"
        return Finding("camera", f"{sentence}, and {other}", fix)
    return Finding("camera", sentence)


def size(case: Case) -> Finding:
    """See whether the part is as near and as large as the network has learned."""
    name, seen = case.part.name, case.seen
    if seen is None:
        return Finding("size", f"the checkpoint does not know in which sizes {name} was trained")
    near, far = case.distances or seen[2:]
    usual = f"{near:.2g} – {far:.2g} m"
    if case.found is None:
        return Finding("size", f"{name} is looked for at {usual}, and nearer and farther")
    z = float(case.found.T_cam_obj[2, 3])
    sentence = f"{name} is {case.length_px:.0f} pixels long at {z:.3g} m"
    if case.elsewhere is None:
        return Finding("size", f"{sentence}; it is looked for at {usual}")
    fix = f"bring it to {usual}, or look there: --distance {0.9 * z:.2g} {1.1 * z:.2g}"
    if not _near(z / math.sqrt(near * far), 5):
        fix += "; such a factor may also be the unit of the part's mesh or of a distance"
    return Finding("size", f"{sentence}, and nothing is found at {usual}", fix)


def visibility(case: Case) -> Finding:
    """See how much of the part the network sees, and what its maps may lack."""
    name = case.part.name
    if case.found is not None:
        count, score = num_keypoints(case.found), case.found.score
        sentence = f"{count} of 9 keypoints of {name}, score {score:.2g}"
        if score >= LEAST_SCORE:
            return Finding("visibility", sentence)
        return Finding("visibility", f"what looks most like {name} hardly does: {sentence}", ABSENT)
    beliefs = case.strongest_beliefs()
    centre, count = float(beliefs[CENTROID]), int((beliefs > PARTLY).sum())
    if centre < PARTLY:
        return Finding(
            "visibility",
            f"nothing like {name} is seen, the belief of its centre is {centre:.2g} at most",
            ABSENT,
        )
    return Finding(
        "visibility",
        f"{name} is seen in part: its centre with a belief of {centre:.2g} and {count} of 9 "
        "keypoints, which make no pose that can be trusted",
        "uncover it, and keep all of it within the picture, not nearer than in training",
    )


def pose(case: Case) -> Finding:
    """See whether keypoints and outline agree with the pose."""
    if case.found is None:
        return Finding("pose", "none to look at")
    one, closer, name = case.found, case.closer, case.part.name
    share = one.reprojection_error_px / case.length_px
    sentence = f"{name}'s keypoints are {one.reprojection_error_px:.1f} pixels off it"
    fix = "check K and the mesh; if both are right, train longer or with more such pictures"
    if share > OFF:
        return Finding("pose", f"{sentence}, {share:.0%} of its length", fix)
    if closer is None:
        return Finding("pose", f"{sentence}; without a mesh its outline is not looked at")
    if closer.agreement is None:
        asked = case.estimator.refiner is not None
        fix = "another background or light; check that the mesh is this part's (--part)"
        sentence += f", its outline tells nothing: {closer.kept}"
        return Finding("pose", sentence, fix if asked else "")
    sentence += f", {closer.agreement:.0%} of its outline agrees"
    fix = "uncover the part; check that the mesh is this part's (--part)"
    return Finding("pose", sentence, "" if closer.agreement >= AGREEING else fix)


def _lens_ratio(case: Case) -> float | None:
    """Return how much longer K's focal length is than training's.

    Only where that puts a part that looks as large as in training to where training had none.
    """
    if case.seen is None or case.distances is not None or case.found is None:
        return None
    learned = Letterbox.fit(case.image.shape[1::-1], case.estimator.checkpoint.input_size)
    length, z = case.length_px * learned.scale_x, float(case.found.T_cam_obj[2, 3])
    smallest, largest, near, far = case.seen
    if near / MARGIN < z < far * MARGIN or not smallest / MARGIN < length < largest * MARGIN:
        return None
    ratio = focal_length(case.K) * learned.scale_x * case.part.diameter / (smallest * far)
    return None if _near(ratio, FOCAL) else ratio


def _near(ratio: float, factor: float) -> bool:
    return 1 / factor < ratio < factor


def _unit_fix(ratio: float) -> str:
    """Say in which unit a mesh is that is so many times too large."""
    for read, metres in UNITS.items():
        for true, own in UNITS.items():
            if read != true and _near(ratio * own / metres, SAME):
                return f"it was read in {read} and is in {true}: --unit {true}"
    return "pass the mesh of the part that the network learned: --part"
