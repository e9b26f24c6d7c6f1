"""ROS messages of a node, as dicts that need no installed ROS.

Poses are in the camera's optical frame, which has OpenCV's axes, or in the world frame of several
cameras, in metres. Quaternions are (x, y, z, w); covariances have translation before rotation.
Topics are named as in DOPE.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import Transform, make_transform, transform
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.inference.pose_result import COLOURS
from dopepp.inference.several_views.views_result import WorldDetection
from dopepp.parts.mesh import face_areas
from dopepp.parts.mesh.decimate import decimate
from dopepp.parts.part import Part
from dopepp.robot.nodes.worker import Answer, Posed

MARKER_FACES: Final = 1000  # largest number of triangles of a marker; its message has 36 kB

TRIANGLE_LIST, ADD, DELETE_ALL = 11, 0, 3  # type and actions of visualization_msgs/Marker
OK, WARN = 0, 1  # levels of diagnostic_msgs/DiagnosticStatus
OVERLAY: Final = "rgb_points"  # topic of the images with drawn poses
DIAGNOSTICS: Final = ("/diagnostics", "diagnostic_msgs/DiagnosticArray")  # topic and type

VISION: Final = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": (
        "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n"
    ),
}
"""Message definitions of ``vision_msgs``, which a ROS installation may lack."""

Fields = dict[str, Any]


@dataclass(frozen=True)
class Message:
    """A ROS message to publish."""

    topic: str  # `/tf`, or a name below the node's (`pose_part` means `/dope/pose_part`)
    kind: str  # message type, `package/Name`
    fields: Fields  # values by field name; nested messages are dicts, image data is bytes


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles of a part's simplified mesh, for RViz markers."""

    corners: Float[np.ndarray, "points 3"]  # 3 corners per triangle, part's frame, metres

    @cached_property
    def points(self) -> list[Fields]:
        """Corners as the fields of ``geometry_msgs/Point`` messages."""
        return [_xyz(corner) for corner in self.corners]


class AnswerFormatter:
    """Converts a worker's answers to ROS messages; a part without a mesh has an empty marker.

    Raises:
        UserError: Part names coincide after characters outside [A-Za-z0-9_] are replaced by _.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self._cuboids = {part.name: part.cuboid for part in parts}
        self._names = {part.name: re.sub(r"\W", "_", part.name, flags=re.ASCII) for part in parts}
        if len(set(self._names.values())) < len(parts):
            problem = f"parts with equal topic names: {', '.join(self._names)}"
            fix = "rename a part and train its network again"
            raise UserError(problem, "names that differ in letters and digits", fix)
        self._triangles = {part.name: _triangles(part) for part in parts}

    def topics(self) -> list[tuple[str, str]]:
        """Return the name and message type of each topic except the diagnostics."""
        names = self._names.values()
        return [
            *((f"pose_{name}", "geometry_msgs/PoseStamped") for name in names),
            *((f"poses_{name}", "geometry_msgs/PoseArray") for name in names),
            ("detections", "vision_msgs/Detection3DArray"),
            ("/tf", "tf2_msgs/TFMessage"),
            ("markers", "visualization_msgs/MarkerArray"),
            (OVERLAY, "sensor_msgs/Image"),
        ]

    def messages(self, answer: Answer, is_wanted: Callable[[str], bool]) -> list[Message]:
        """Return the messages of an answer, for topics on which ``is_wanted`` returns true."""
        header = _header(answer.stamp, answer.frame_id)
        makers: dict[str, Callable[[], Fields]] = {}
        for name, word in self._names.items():
            copies = [pose for pose in answer.detections if pose.object == name]
            copies.sort(key=lambda detection: -detection.score)
            poses = [_pose(_transform(detection)) for detection in copies]
            if poses:
                makers[f"pose_{word}"] = partial(dict, header=header, pose=poses[0])
            makers[f"poses_{word}"] = partial(dict, header=header, poses=poses)
        makers |= {
            "detections": lambda: self._detections(answer, header),
            "/tf": lambda: self._transforms(answer, header),
            "markers": lambda: self._markers(answer, header),
            OVERLAY: lambda: image_fields(answer.result.plot(), header),
        }
        return [
            Message(topic, kind, makers[topic]())
            for topic, kind in self.topics()
            if topic in makers and is_wanted(topic)
        ]

    def _frames(self, answer: Answer) -> list[tuple[str, Posed]]:
        """Return (TF frame name, detection) pairs; the name is ``<object>_<n>``."""
        return [
            (f"{self._names[detection.object]}_{number}", detection)
            for number, detection in zip(answer.numbers, answer.detections, strict=True)
        ]

    def _detections(self, answer: Answer, header: Fields) -> Fields:
        """Return ``vision_msgs/Detection3DArray`` fields, with the parts' cuboids as boxes."""
        detections = []
        for name, detection in self._frames(answer):
            cuboid, T = self._cuboids[detection.object], _transform(detection)
            centre = make_transform(T[:3, :3], transform(T, cuboid[-1]))
            box = {"center": _pose(centre), "size": _xyz(np.ptp(cuboid, axis=0))}
            results = [_hypothesis(detection)]
            detections.append({"header": header, "results": results, "bbox": box, "id": name})
        return {"header": header, "detections": detections}

    def _transforms(self, answer: Answer, header: Fields) -> Fields:
        """Return the fields of ``tf2_msgs/TFMessage``."""
        transforms = []
        for name, detection in self._frames(answer):
            pose = _pose(_transform(detection))
            fields = {"translation": pose["position"], "rotation": pose["orientation"]}
            transforms.append({"header": header, "child_frame_id": name, "transform": fields})
        return {"transforms": transforms}

    def _markers(self, answer: Answer, header: Fields) -> Fields:
        """Return ``visualization_msgs/MarkerArray`` fields; delete the last image's markers."""
        markers: list[Fields] = [{"header": header, "action": DELETE_ALL}]
        for index, detection in enumerate(answer.detections):
            red, green, blue = (np.array(COLOURS[index % len(COLOURS)]) / 255).tolist()
            identity = {"header": header, "ns": detection.object, "id": index}
            kind = {"type": TRIANGLE_LIST, "action": ADD, "scale": _xyz(np.ones(3))}
            pose, points = _pose(_transform(detection)), self._triangles[detection.object]
            colour = {"r": red, "g": green, "b": blue, "a": 0.8}
            markers.append({**identity, **kind, "pose": pose, "color": colour, "points": points})
        return {"markers": markers}


def diagnosis(stamp: int, name: str, problem: str, values: dict[str, str]) -> Message:
    """Return the diagnostic message of a node; the level is OK if ``problem`` is empty."""
    status = {
        "level": WARN if problem else OK,
        "name": f"{name}: poses",
        "message": problem or "running",
        "hardware_id": "",
        "values": [{"key": key, "value": value} for key, value in values.items()],
    }
    return Message(*DIAGNOSTICS, {"header": _header(stamp, ""), "status": [status]})


def _header(stamp: int, frame_id: str) -> Fields:
    sec, nanosec = divmod(stamp, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}


def image_fields(image: RGBImage, header: Fields) -> Fields:
    """Return the fields of ``sensor_msgs/Image``."""
    height, width = image.shape[:2]
    size = {"height": height, "width": width, "step": 3 * width}
    layout = {"encoding": "rgb8", "is_bigendian": 0}
    return {"header": header, **size, **layout, "data": image.tobytes()}


def _transform(detection: Posed) -> Transform:
    """Return the pose of a detection in the frame of the answer."""
    return detection.T_world_obj if isinstance(detection, WorldDetection) else detection.T_cam_obj


def _hypothesis(detection: Posed) -> Fields:
    """Return ``vision_msgs/ObjectHypothesisWithPose`` fields, with ROS's order of covariances."""
    order = [3, 4, 5, 0, 1, 2]
    covariance = detection.covariance[np.ix_(order, order)]
    return {
        "hypothesis": {"class_id": detection.object, "score": float(detection.score)},
        "pose": {"pose": _pose(_transform(detection)), "covariance": covariance.ravel().tolist()},
    }


def _pose(T: Transform) -> Fields:
    """Return the fields of ``geometry_msgs/Pose``."""
    w, x, y, z = matrix_to_quaternion(T[:3, :3]).tolist()
    return {"position": _xyz(T[:3, 3]), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _xyz(values: Float[np.ndarray, "3"]) -> Fields:
    return dict(zip("xyz", values.tolist(), strict=True))


def _triangles(part: Part) -> Triangles:
    """Return a part's mesh with at most 1000 faces; empty if the part has no mesh."""
    if part.mesh is None:
        return Triangles(np.zeros((0, 3)))
    vertices, faces = part.mesh.vertices, part.mesh.faces
    faces = faces[face_areas(vertices, faces) > 0]
    if len(faces) > MARKER_FACES:
        vertices, faces, _, _ = decimate(vertices, faces, None, MARKER_FACES)
    return Triangles(vertices[faces].reshape(-1, 3))
