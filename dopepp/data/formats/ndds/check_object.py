"""Hold the fields of one NDDS object against each other and against the image.

What may differ between NDDS data sets but not within one, counted object by object.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dopepp.data.formats.ndds.check_fields import (
    EDGE_SHARE,
    ObjectFields,
    box_axes,
    quarter_turn_distance,
    size_problem,
    text,
)
from dopepp.data.formats.problems import CheckReport
from dopepp.data.formats.tolerances import Box, box_problem, translation_problem
from dopepp.geometry.camera import project
from dopepp.geometry.rotation import is_rotation

DOCUMENTED: Final = {
    "quaternion_xyzw": "x, y, z, w",
    "bounding_box": "row, column",
    "camera axes": "OpenCV",
}
"""NDDS's own habits."""

_MAX_MINORITY: Final = 1000
"""Objects of each habit that are remembered, in case they turn out to be the minority."""


class Conventions:
    """Collects habits; a data set's common one is noted, another one is a defect."""

    def __init__(self, report: CheckReport) -> None:
        self._report = report
        self._votes: dict[str, Counter[str]] = {}
        self._places: dict[tuple[str, str], list[tuple[Path, str]]] = {}

    def vote(self, habit: str, value: str, path: Path, where: str) -> None:
        """Count one object's habit."""
        self._votes.setdefault(habit, Counter())[value] += 1
        places = self._places.setdefault((habit, value), [])
        if len(places) < _MAX_MINORITY:
            places.append((path, where))

    def conclude(self) -> None:
        """Note each habit that is not NDDS's own, and report the objects that have another."""
        for habit, votes in self._votes.items():
            (common, number), *rest = votes.most_common()
            if common != DOCUMENTED[habit]:
                self._report.note(f"{habit}: {common} ({number:,} objects)")
            for value, _ in rest:
                for path, where in self._places[habit, value]:
                    self._report.add(path, where, f"{value}; {number:,} objects have {common}")


PROJECTION_PX: Final = 2.0
PROJECTION_SHARE: Final = 0.02
"""A stated projection may be off by this much: pixels, plus a share of the cuboid's longer side."""

ORIENTATION_RAD: Final = np.deg2rad(2.0)
"""Between orientations that a file states twice."""

MATRIX_TOLERANCE: Final = 5e-3
"""Of ``pose_transform`` from a rotation: FAT rounds to four digits."""

_OPENGL: Final = np.diag([1.0, -1.0, -1.0])


class ObjectCheck:
    """One object; lengths are in the file's unit, whatever it is.

    Args:
        fields: Its fields.
        path: The annotation.
        habits: Collects what the data set does one way or the other.
    """

    def __init__(self, fields: ObjectFields, path: Path, habits: Conventions) -> None:
        self._fields, self._path, self._habits = fields, path, habits

    def check(
        self,
        K: NDArray[np.float64] | None,
        size: tuple[int, int] | None,
        mask: NDArray[np.bool_] | None,
        sides: NDArray[np.float64] | None,
    ) -> None:
        """Check pose, cuboid, projections and boxes.

        Args:
            K: Camera matrix, None where it is not known.
            size: (width, height) of the image, None where it cannot be read.
            mask: The object's pixels, None where they are not known.
            sides: Its class's ``cuboid_dimensions``, None where they are not known.
        """
        fields = self._fields
        if fields.cuboid is not None:
            problem = None if sides is None else size_problem(fields.cuboid, sides)
            if problem is not None:
                fields.add(f"cuboid.{problem[0]}", problem[1])
            self._check_orientation(fields.cuboid)
        self._check_transforms()
        seen = None if mask is None else Box.of_mask(mask)
        if seen is not None and not fields.is_hidden:
            self._check_bounding_box(seen)
        if fields.location is None or fields.is_hidden:
            return
        axes = self._camera_axes(fields.location, K)
        if self._is_place_possible(fields.location, axes) and K is not None:
            fraction = None if mask is None else fields.visibility
            self._check_image(axes, K, size, seen, fraction)

    def _check_orientation(self, cuboid: NDArray[np.float64]) -> None:
        """Hold the quaternion against the cuboid: equal up to quarter turns, in either order."""
        axes, rotations = box_axes(cuboid), self._fields.rotations
        if axes is None or rotations is None:
            return
        fits = {
            order: quarter_turn_distance(rotation.T @ axes) <= ORIENTATION_RAD
            for order, rotation in rotations.items()
        }
        self._judge("quaternion_xyzw", fits, "not the cuboid's orientation in either order")

    def _judge(self, habit: str, fits: dict[str, bool], problem: str) -> None:
        """Count which of two habits a field has, where it can be told; neither is a defect."""
        if not any(fits.values()):
            self._fields.add(habit, problem)
        elif not all(fits.values()):
            value = next(value for value, fit in fits.items() if fit)
            self._habits.vote(habit, value, self._path, self._fields.place(habit))

    def _check_transforms(self) -> None:
        """Check NDDS's matrix: rows P·Rᵀ (mirrored: Unreal is left-handed), the location below."""
        fields = self._fields
        for name, matrix in fields.transforms.items():
            linear = matrix[:3, :3]
            upright = linear * np.sign(np.linalg.det(linear))
            if not is_rotation(upright, MATRIX_TOLERANCE):
                fields.add(name, f"no rotation (mirrored or not) within {MATRIX_TOLERANCE}")
                continue
            candidates = [
                quarter_turn_distance(rotation.T @ turned)
                for rotation in (fields.rotations or {}).values()
                for turned in (upright, upright.T)
            ]
            if candidates and min(candidates) > ORIENTATION_RAD:
                fields.add(name, "another rotation than quaternion_xyzw, in either order")
            if fields.location is not None:
                places = matrix[3, :3], matrix[:3, 3]
                scale = max(1.0, float(np.abs(fields.location).max()))
                if min(np.abs(p - fields.location).max() for p in places) > EDGE_SHARE * scale:
                    message = f"translation {text(places[0])}; location {text(fields.location)}"
                    fields.add(name, message)

    def _check_bounding_box(self, seen: Box) -> None:
        """Hold the stated box, which may be the whole object's, against what is seen."""
        if self._fields.bounding_box is None:
            return
        (a, b), (c, d) = (corner.tolist() for corner in self._fields.bounding_box)
        boxes = {"row, column": Box(b, a, d, c), "column, row": Box(a, b, c, d)}
        fits = {order: box.holds(seen, PROJECTION_PX) for order, box in boxes.items()}
        problem = f"{boxes['row, column']} does not hold the mask's {seen}"
        self._judge("bounding_box", fits, problem)

    def _camera_axes(
        self, location: NDArray[np.float64], K: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Return the file's camera axes as a matrix into OpenCV's.

        A point behind an OpenCV camera is before an OpenGL one if it then projects to where the
        file says.
        """
        fields, is_opengl = self._fields, False
        is_before = fields.cuboid is not None and fields.cuboid[:, 2].mean() > 0
        if location[2] < 0 and not is_before and fields.projected is not None and K is not None:
            middle, slack = project(_OPENGL @ location, K), np.ptp(fields.projected, axis=0)
            low = fields.projected.min(axis=0) - slack
            high = fields.projected.max(axis=0) + slack
            is_opengl = bool(((low <= middle) & (middle <= high)).all())
        value = "OpenGL" if is_opengl else "OpenCV"
        self._habits.vote("camera axes", value, self._path, fields.place("location"))
        return _OPENGL if is_opengl else np.eye(3)

    def _is_place_possible(self, location: NDArray[np.float64], axes: NDArray[np.float64]) -> bool:
        """Check location, centroid and unit; tell whether projections can mean anything."""
        fields, cuboid = self._fields, self._fields.cuboid
        diagonal = None if cuboid is None else float(np.linalg.norm(cuboid[0] - cuboid[6]))
        problem = translation_problem(axes @ location, diagonal)
        if problem is not None:
            fields.add(f"location.{problem[0]}", problem[1])
            return False
        if cuboid is None or diagonal is None:
            return True
        middle = cuboid.mean(axis=0)
        centroid = fields.centroid
        if centroid is not None and np.linalg.norm(centroid - middle) > EDGE_SHARE * diagonal:
            fields.add("cuboid_centroid", f"{text(centroid)}; the cuboid's is {text(middle)}")
        if np.linalg.norm(location - middle) <= 2 * diagonal:
            return True
        message = f"{text(location)}, far from its cuboid at {text(middle)}: in another unit?"
        fields.add("location.unit", message)
        return False

    def _check_image(
        self,
        axes: NDArray[np.float64],
        K: NDArray[np.float64],
        size: tuple[int, int] | None,
        seen: Box | None,
        fraction: float | None,
    ) -> None:
        """Hold projections and what is seen against the cuboid, or against each other."""
        fields = self._fields
        if fields.cuboid is not None:
            points = fields.cuboid @ axes.T
            self._check_projections(points, K)
        elif fields.projected is not None:
            # Points at depth 1 that project onto what the file states.
            rays = np.column_stack([fields.projected, np.ones(len(fields.projected))])
            points = rays @ np.linalg.inv(K).T
        else:
            return
        problem = box_problem(points, K, seen, fraction, size)
        if problem is not None:
            fields.add("box", problem)

    def _check_projections(self, cuboid: NDArray[np.float64], K: NDArray[np.float64]) -> None:
        expected = project(np.vstack([cuboid, cuboid.mean(axis=0)]), K)
        if not np.isfinite(expected).all():
            return  # of what reaches behind the camera, projections mean nothing
        allowed = PROJECTION_PX + PROJECTION_SHARE * float(np.ptp(expected, axis=0).max())
        pairs = (
            ("projected_cuboid", self._fields.projected, expected[:8]),
            ("projected_cuboid_centroid", self._fields.projected_centroid, expected[8:]),
        )
        for name, stated, true in pairs:
            distance = 0.0 if stated is None else np.linalg.norm(stated - true, axis=-1).max()
            if distance > allowed:
                message = f"{distance:.3g} px from the cuboid's image (allowed {allowed:.2g} px)"
                self._fields.add(name, message)
