"""Check that the fields of an NDDS object agree with each other and with the image.

Tolerances, in addition to :mod:`~dopepp.data.formats.invariants`: 2 px plus 2 % of the
cuboid's longer side for a stated projection; 2 % for perpendicular and equal edges of a cuboid, 5 %
for the sides of its class; 2 degrees for an orientation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.data.formats.invariants import Box, check_box, check_translation
from dopepp.data.formats.ndds import NddsObject
from dopepp.data.formats.ndds.conventions import OPENGL
from dopepp.data.formats.problems import CheckReport, Node, mapping
from dopepp.drawing.pictures import Mask, Shape
from dopepp.geometry.camera import CameraMatrix, project
from dopepp.geometry.rotation import (
    RotationMatrix,
    Vector,
    is_rotation,
    quaternion_to_matrix,
    rotation_angle,
)

Corners = Float[np.ndarray, "8 3"]

PROJECTION_PX: Final = 2.0
PROJECTION_SHARE: Final = 0.02
"""Allowed error of a stated projection: pixels, plus a share of the cuboid's longer side."""

ORIENTATION_RAD: Final = np.deg2rad(2.0)  # angle between two statements of an orientation
MATRIX_TOLERANCE: Final = 5e-3  # deviation of ``pose_transform`` from a rotation
NORM_TOLERANCE: Final = 0.01  # deviation of a quaternion's norm from 1
EDGE_SHARE: Final = 0.02
"""Allowed inequality and slant of edges, as a share of the longest; a thinner box is flat."""

SIZE_SHARE: Final = 0.05  # difference of edges from the class's ``cuboid_dimensions``


_EDGES: Final = np.array(
    [
        [(1, 0), (2, 3), (5, 4), (6, 7)],
        [(0, 3), (1, 2), (4, 7), (5, 6)],
        [(4, 0), (5, 1), (6, 2), (7, 3)],
    ]
)
"""Corner pairs of the edges along x, y and z, from the negative to the positive end."""

_DOCUMENTED: Final = ("x, y, z, w", "row, column", "OpenCV")  # conventions of NDDS
_MAX_MINORITY: Final = 1000  # stored objects per convention, for reports of minorities


class Majority:
    """Counts of objects per convention, to report objects that differ from the majority."""

    def __init__(self, report: CheckReport) -> None:
        self._report = report
        self._votes: dict[str, Counter[str]] = {}
        self._nodes: dict[tuple[str, str], list[Node]] = {}

    def vote(self, subject: str, convention: str, node: Node) -> None:
        """Count one object's convention of ``subject``, e.g. ``bounding_box``."""
        self._votes.setdefault(subject, Counter())[convention] += 1
        nodes = self._nodes.setdefault((subject, convention), [])
        if len(nodes) < _MAX_MINORITY:
            nodes.append(node)

    def conclude(self) -> None:
        """Note each majority that NDDS does not document, and report the objects of minorities."""
        for subject, votes in self._votes.items():
            (common, number), *rest = votes.most_common()
            if common not in _DOCUMENTED:
                self._report.note(f"{subject}: {common} ({number:,} objects)")
            for convention, _ in rest:
                for node in self._nodes[subject, convention]:
                    node.report(f"{convention}; {number:,} objects have {common}")


class ObjectCheck:
    """Check of an object, with lengths in the file's unknown unit; damaged fields are None."""

    def __init__(self, parsed: NddsObject, item: Mapping[str, Any], majority: Majority) -> None:
        self._node, self._item, self._majority = parsed.node, item, majority
        self._visibility = parsed.visibility
        self._location, self._quaternion = _finite(parsed.location), _finite(parsed.quaternion)
        self._projected, self._cuboid = _finite(parsed.corners_px), _finite(parsed.cuboid)
        self._centroid = _finite(parsed.centroid)
        self._projected_centroid = self._numbers("projected_cuboid_centroid", 2)

    def check(
        self, K: CameraMatrix | None, shape: Shape | None, mask: Mask | None, sides: Vector | None
    ) -> None:
        """Report contradictions between pose, cuboid, projections, boxes and mask.

        Args:
            K: Camera matrix in pixels, if known.
            shape: (height, width) of the image, if known.
            mask: Visible pixels, if known.
            sides: The class's ``cuboid_dimensions``, if known.
        """
        rotations = self._rotations()
        if self._cuboid is not None:
            self._check_cuboid(self._cuboid, rotations, sides)
        self._check_transforms(rotations)
        # The file may state that the object is hidden (0) or its visibility unknown (−1).
        is_hidden = self._visibility is not None and self._visibility <= 0
        visible_box = None if mask is None else Box.of_mask(mask)
        self._check_bounding_box(None if is_hidden else visible_box)
        if self._location is None or is_hidden:
            return
        axes = self._camera_axes(self._location, K)
        if not self._is_location_possible(self._location, axes) or K is None:
            return
        if self._cuboid is not None:
            points = self._cuboid @ axes.T
            self._check_projections(points, K)
        elif self._projected is not None:
            # Points at depth 1 that project onto ``projected_cuboid``.
            points = np.column_stack([self._projected, np.ones(8)]) @ np.linalg.inv(K).T
        else:
            return
        fraction = None if mask is None else self._visibility
        check_box(self._node["box"], points, K, visible_box, fraction, shape)

    def _numbers(self, field: str, *shape: int) -> Float[np.ndarray, "..."] | None:
        """Return a field's numbers; None if they are missing or damaged; damage is reported."""
        value = self._item.get(field)
        return None if value is None else _finite(self._node[field].numbers(value, *shape))

    def _rotations(self) -> dict[str, RotationMatrix]:
        """Return the object's rotation for each order of ``quaternion_xyzw``; empty if damaged."""
        stored = self._quaternion
        if stored is None:
            return {}
        norm = float(np.linalg.norm(stored))
        if abs(norm - 1) > NORM_TOLERANCE:
            message = f"not a rotation: norm {norm:.4g}; allowed: 1 ± {NORM_TOLERANCE}"
            self._node["quaternion_xyzw"].report(message)
            return {}
        orders = {"x, y, z, w": np.roll(stored, 1), "w, x, y, z": stored}
        return {order: quaternion_to_matrix(values) for order, values in orders.items()}

    def _compare_conventions(self, field: str, fits: dict[str, bool], problem: str) -> None:
        """Report a field that fits no convention, and count its convention if only some fit."""
        if not any(fits.values()):
            self._node[field].report(problem)
        elif not all(fits.values()):
            convention = next(convention for convention, fit in fits.items() if fit)
            self._majority.vote(field, convention, self._node[field])

    def _check_cuboid(
        self, corners: Corners, rotations: Mapping[str, RotationMatrix], sides: Vector | None
    ) -> None:
        """Report a cuboid that is no box, or contradicts its class's sides or the quaternion."""
        edges = corners[_EDGES[..., 1]] - corners[_EDGES[..., 0]]
        means = edges.mean(axis=1)
        lengths = np.linalg.norm(means, axis=1)
        smallest = EDGE_SHARE * lengths.max()
        is_box, axes = np.abs(edges - means[:, None]).max() <= smallest, None
        if lengths.min() > smallest:  # a flat box has no third direction
            axes = np.asarray((means / lengths[:, None]).T)
            is_box &= np.abs(axes.T @ axes - np.eye(3)).max() <= EDGE_SHARE
        if not is_box:
            message = "not a box in NDDS order: edges must be parallel, equal, orthogonal"
            self._node["cuboid"].report(message)
            self._cuboid = None
            return
        lengths = np.linalg.norm(edges[:, 0], axis=1)
        if sides is not None and np.abs(lengths - sides).max() > SIZE_SHARE * sides.max():
            power = np.log10(max(lengths.max(), 1e-12) / sides.max())
            is_power = abs(round(power)) >= 1 and abs(power - round(power)) < SIZE_SHARE
            message = f"edges {_text(lengths)}; its class has cuboid_dimensions {_text(sides)}"
            self._node["cuboid"]["unit" if is_power else "size"].report(message)
        if axes is not None and rotations:
            fits = {
                order: _quarter_turn_distance(rotation.T @ axes) <= ORIENTATION_RAD
                for order, rotation in rotations.items()
            }
            message = "not the cuboid's orientation in either order"
            self._compare_conventions("quaternion_xyzw", fits, message)

    def _check_transforms(self, rotations: Mapping[str, RotationMatrix]) -> None:
        """Check ``pose_transform``: rows P·Rᵀ (P mirrors: Unreal is left-handed) above location."""
        for name in ("pose_transform", "pose_transform_permuted"):
            matrix = self._numbers(name, 4, 4)
            if matrix is None:
                continue
            upright = matrix[:3, :3] * np.sign(np.linalg.det(matrix[:3, :3]))
            if not is_rotation(upright, MATRIX_TOLERANCE):
                self._node[name].report(
                    f"not a rotation (mirrored or not) within {MATRIX_TOLERANCE}"
                )
                continue
            distances = [
                _quarter_turn_distance(rotation.T @ rotated)
                for rotation in rotations.values()
                for rotated in (upright, upright.T)
            ]
            if distances and min(distances) > ORIENTATION_RAD:
                self._node[name].report("another rotation than quaternion_xyzw, in either order")
            if self._location is not None:
                candidates = matrix[3, :3], matrix[:3, 3]
                scale = max(1.0, float(np.abs(self._location).max()))
                if min(np.abs(c - self._location).max() for c in candidates) > EDGE_SHARE * scale:
                    message = (
                        f"translation {_text(candidates[0])}; location {_text(self._location)}"
                    )
                    self._node[name].report(message)

    def _check_bounding_box(self, visible_box: Box | None) -> None:
        entry = mapping(self._item.get("bounding_box"))
        if not entry:
            return
        node = self._node["bounding_box"]
        first, last = (
            _finite(node[name].numbers(entry.get(name), 2)) for name in ("top_left", "bottom_right")
        )
        if first is None or last is None:
            return
        if (first > last).any():
            node.report(f"top_left {first.tolist()}, bottom_right {last.tolist()}")
        elif visible_box is not None:
            (a, b), (c, d) = first.tolist(), last.tolist()
            boxes = {"row, column": Box(b, a, d, c), "column, row": Box(a, b, c, d)}
            fits = {
                order: box.excess_px(visible_box) <= PROJECTION_PX for order, box in boxes.items()
            }
            problem = f"{boxes['row, column']} does not contain the mask's box {visible_box}"
            self._compare_conventions("bounding_box", fits, problem)

    def _camera_axes(self, location: Vector, K: CameraMatrix | None) -> RotationMatrix:
        """Return the rotation from the file's camera axes to OpenCV's."""
        # A point behind the camera has OpenGL axes if it then projects to the stated corners.
        projected, is_opengl = self._projected, False
        is_before = self._cuboid is not None and self._cuboid[:, 2].mean() > 0
        if location[2] < 0 and not is_before and projected is not None and K is not None:
            middle, slack = project(OPENGL @ location, K), np.ptp(projected, axis=0)
            low, high = projected.min(axis=0) - slack, projected.max(axis=0) + slack
            is_opengl = bool(((low <= middle) & (middle <= high)).all())
        axes = "OpenGL" if is_opengl else "OpenCV"
        self._majority.vote("camera axes", axes, self._node["location"])
        return OPENGL if is_opengl else np.eye(3)

    def _is_location_possible(self, location: Vector, axes: RotationMatrix) -> bool:
        """Check location, centroid and unit; return whether the object may be projected."""
        cuboid, centroid = self._cuboid, self._centroid
        diagonal = None if cuboid is None else float(np.linalg.norm(cuboid[0] - cuboid[6]))
        if not check_translation(self._node["location"], axes @ location, diagonal):
            return False
        if cuboid is None or diagonal is None:
            return True
        middle = cuboid.mean(axis=0)
        if centroid is not None and np.linalg.norm(centroid - middle) > EDGE_SHARE * diagonal:
            message = f"{_text(centroid)}; the cuboid's centre is {_text(middle)}"
            self._node["cuboid_centroid"].report(message)
        if np.linalg.norm(location - middle) <= 2 * diagonal:
            return True
        message = f"{_text(location)}, far from its cuboid at {_text(middle)}: in another unit?"
        self._node["location.unit"].report(message)
        return False

    def _check_projections(self, cuboid: Corners, K: CameraMatrix) -> None:
        expected = project(np.vstack([cuboid, cuboid.mean(axis=0)]), K)
        if not np.isfinite(expected).all():
            return  # projections of an object partly behind the camera are meaningless
        allowed = PROJECTION_PX + PROJECTION_SHARE * float(np.ptp(expected, axis=0).max())
        pairs = (
            ("projected_cuboid", self._projected, expected[:8]),
            ("projected_cuboid_centroid", self._projected_centroid, expected[8:]),
        )
        for name, annotated, true in pairs:
            distance = 0.0 if annotated is None else np.linalg.norm(annotated - true, axis=-1).max()
            if distance > allowed:
                message = f"{distance:.3g} px from the cuboid's image (allowed {allowed:.2g} px)"
                self._node[name].report(message)


def _finite(values: Float[np.ndarray, "..."] | None) -> Float[np.ndarray, "..."] | None:
    return values if values is not None and np.isfinite(values).all() else None


def _quarter_turn_distance(rotation: RotationMatrix) -> float:
    """Return the angle (radians) to the nearest matrix that permutes and flips axes."""
    # The object frames of different tools differ by these matrices.
    nearest = np.where(np.abs(rotation) == np.abs(rotation).max(axis=0), np.sign(rotation), 0.0)
    if abs(np.linalg.det(nearest)) != 1:
        return np.inf
    return float(rotation_angle(nearest.T @ rotation))


def _text(values: Float[np.ndarray, " n"]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
