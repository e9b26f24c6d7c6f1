"""What a node says of a picture, in ROS's messages as plain values.

Poses are in the camera's optical frame, which is OpenCV's. Quaternions are (x, y, z, w) there, and
a covariance is of shift and turn, in this order. Names of topics are DOPE's.
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
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import Transform
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.inference.pose_result import COLOURS
from dopepp.parts.mesh import face_areas
from dopepp.parts.mesh.decimate import decimate
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection
from dopepp.robot.nodes.worker import Answer, Stamp

MARKER_FACES: Final = 1000
"""Triangles of a marker: a viewer shows the part, and a message of it has 36 kB."""

TRIANGLE_LIST: Final = 11
ADD: Final = 0
DELETE_ALL: Final = 3
OK: Final = 0
WARN: Final = 1  # these two are levels of a diagnosis
OVERLAY: Final = "rgb_points"  # topic of the pictures with poses drawn on them
DIAGNOSTICS: Final = ("/diagnostics", "diagnostic_msgs/DiagnosticArray")
"""Topic and type of a diagnosis."""

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
"""Fields of ``vision_msgs``, which not every installation has."""

Fields = dict[str, Any]


@dataclass(frozen=True)
class Message:
    """A message."""

    # Where it goes: `pose_part` is below the node's name (`/dope/pose_part`), `/tf` is not.
    topic: str
    kind: str  # its type, `package/Name`
    fields: Fields  # its fields by name; a message inside it is a dict, a picture's data are bytes


@dataclass(frozen=True, eq=False)
class Triangles:
    """A part's triangles for markers, the same object each time."""

    corners: Float[np.ndarray, "points 3"]

    @cached_property
    def points(self) -> list[Fields]:
        """Three points a triangle."""
        return [_xyz(one) for one in self.corners]


class Speaker:
    """Says what a worker has found.

    Args:
        parts: The worker's, with meshes where there are any.

    Raises:
        UserError: Two parts' names give one topic.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self._cuboids = {part.name: part.cuboid for part in parts}
        self._names = {part.name: re.sub(r"\W", "_", part.name, flags=re.ASCII) for part in parts}
        if len(set(self._names.values())) < len(parts):
            got = f"parts {', '.join(self._names)}"
            raise UserError(got, "names that differ in letters and digits", "rename one of them")
        self._triangles = {part.name: _triangles(part) for part in parts}

    def topics(self) -> list[tuple[str, str]]:
        """Return every topic with its type, but for the diagnosis."""
        own = [(f"pose_{name}", "geometry_msgs/PoseStamped") for name in self._names.values()]
        own += [(f"poses_{name}", "geometry_msgs/PoseArray") for name in self._names.values()]
        return [
            *own,
            ("detections", "vision_msgs/Detection3DArray"),
            ("/tf", "tf2_msgs/TFMessage"),
            ("markers", "visualization_msgs/MarkerArray"),
            (OVERLAY, "sensor_msgs/Image"),
        ]

    def messages(self, answer: Answer, wanted: Callable[[str], bool]) -> list[Message]:
        """Return what there is to say about a picture on the topics that are wanted."""
        header = {"stamp": answer.stamp._asdict(), "frame_id": answer.frame_id}
        makers: dict[str, Callable[[], Fields]] = {}
        for name, word in self._names.items():
            found = [one for one in answer.result.detections if one.object == name]
            poses = [_pose(one.T_cam_obj) for one in sorted(found, key=lambda one: -one.score)]
            if poses:
                makers[f"pose_{word}"] = partial(dict, header=header, pose=poses[0])
            makers[f"poses_{word}"] = partial(dict, header=header, poses=poses)
        makers |= {
            "detections": lambda: self._detections(answer, header),
            "/tf": lambda: self._transforms(answer, header),
            "markers": lambda: self._markers(answer, header),
            OVERLAY: lambda: picture(answer.result.plot(), header),
        }
        kinds = {topic: kind for topic, kind in self.topics() if topic in makers and wanted(topic)}
        return [Message(topic, kind, makers[topic]()) for topic, kind in kinds.items()]

    def _named(self, answer: Answer) -> list[tuple[str, Detection]]:
        """Return every detection with its frame's name, ``<object>_<n>``."""
        return [
            (f"{self._names[one.object]}_{number}", one)
            for number, one in zip(answer.numbers, answer.result.detections, strict=True)
        ]

    def _detections(self, answer: Answer, header: Fields) -> Fields:
        detections = [
            {"header": header, "results": [_hypothesis(one)], "bbox": self._box(one), "id": name}
            for name, one in self._named(answer)
        ]
        return {"header": header, "detections": detections}

    def _box(self, one: Detection) -> Fields:
        """Return the part's box, whose middle need not be the part's origin."""
        cuboid, middle = self._cuboids[one.object], one.T_cam_obj.copy()
        middle[:3, 3] += middle[:3, :3] @ cuboid[-1]
        return {"center": _pose(middle), "size": _xyz(np.ptp(cuboid, axis=0))}

    def _transforms(self, answer: Answer, header: Fields) -> Fields:
        transforms = []
        for name, one in self._named(answer):
            pose = _pose(one.T_cam_obj)
            shift_and_turn = {"translation": pose["position"], "rotation": pose["orientation"]}
            transforms.append(
                {"header": header, "child_frame_id": name, "transform": shift_and_turn}
            )
        return {"transforms": transforms}

    def _markers(self, answer: Answer, header: Fields) -> Fields:
        """Return the parts' triangles at their poses, in place of those of the last picture."""
        markers: list[Fields] = [{"header": header, "action": DELETE_ALL}]
        for index, one in enumerate(answer.result.detections):
            colour = (np.array(COLOURS[index % len(COLOURS)]) / 255).tolist()
            marker = {"header": header, "ns": one.object, "id": index, "type": TRIANGLE_LIST}
            marker |= {"action": ADD, "pose": _pose(one.T_cam_obj), "scale": _xyz(np.ones(3))}
            marker |= {"color": {**dict(zip("rgb", colour, strict=True)), "a": 0.8}}
            markers.append(marker | {"points": self._triangles[one.object]})
        return {"markers": markers}


def diagnosis(stamp: Stamp, name: str, trouble: str, values: dict[str, str]) -> Message:
    """Return how a node does; ``trouble`` is what is wrong, empty where nothing is."""
    status = {
        "level": WARN if trouble else OK,
        "name": f"{name}: poses",
        "message": trouble or "running",
        "hardware_id": "",
        "values": [{"key": key, "value": value} for key, value in values.items()],
    }
    header = {"stamp": stamp._asdict(), "frame_id": ""}
    return Message(*DIAGNOSTICS, {"header": header, "status": [status]})


def picture(image: Picture, header: Fields) -> Fields:
    """Return an RGB picture as ``sensor_msgs/Image``."""
    height, width = image.shape[:2]
    return {
        "header": header, "height": height, "width": width, "encoding": "rgb8",
        "is_bigendian": 0, "step": 3 * width, "data": image.tobytes(),
    }  # fmt: skip


def _hypothesis(one: Detection) -> Fields:
    order = [3, 4, 5, 0, 1, 2]
    covariance = one.covariance[np.ix_(order, order)]
    return {
        "hypothesis": {"class_id": one.object, "score": float(one.score)},
        "pose": {"pose": _pose(one.T_cam_obj), "covariance": covariance.ravel().tolist()},
    }


def _pose(T: Transform) -> Fields:
    w, x, y, z = matrix_to_quaternion(T[:3, :3]).tolist()
    return {"position": _xyz(T[:3, 3]), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _xyz(values: Float[np.ndarray, "3"]) -> Fields:
    return dict(zip("xyz", values.tolist(), strict=True))


def _triangles(part: Part) -> Triangles:
    """Return a part's triangles, few enough to send with every picture; none without a mesh."""
    if part.mesh is None:
        return Triangles(np.zeros((0, 3)))
    vertices, faces = part.mesh.vertices, part.mesh.faces
    faces = faces[face_areas(vertices, faces) > 0]
    if len(faces) > MARKER_FACES:
        vertices, faces, _, _ = decimate(vertices, faces, None, MARKER_FACES)
    return Triangles(vertices[faces].reshape(-1, 3))
